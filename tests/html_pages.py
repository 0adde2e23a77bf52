"""HTML pages, read back by the standard library's parser."""

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "link", "img", "rect", "path", "br"}


@dataclass
class Page(HTMLParser):
    """What is on a page.

    Attributes:
        tables: the paragraph or heading above → lines of cells, the head first.
        tags: name and attributes of each element, in order.
        words: all text outside of styles.
    """

    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    words: str = ""
    _open: list[str] = field(default_factory=list)
    _above: str = ""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.append((tag, values))
        if tag not in VOID:
            self._open.append(tag)
        if tag in ("p", "h2", "h3"):
            self._above = ""
        elif tag == "tr":
            self.tables.setdefault(self._above, []).append([])
        elif tag in ("td", "th"):
            self.tables[self._above][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.words += data
        if "td" in self._open or "th" in self._open:
            self.tables[self._above][-1][-1] += data
        elif {"p", "h2", "h3"} & {*self._open}:
            self._above += data

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        """Return the attributes of all elements of a kind."""
        return [attributes for name, attributes in self.tags if name == tag]

    def table(self, title: str) -> list[list[str]]:
        """Return the table below the paragraph that begins so."""
        (found,) = [lines for above, lines in self.tables.items() if above.startswith(title)]
        return found

    @property
    def text(self) -> str:
        """All words, with single spaces."""
        return " ".join(self.words.split())


def read_page(text: str) -> Page:
    """Parse a page, every element of which has to be closed."""
    page = Page()
    page.feed(text)
    page.close()
    assert page._open == []
    return page
