"""HTML pages, read back by the standard library's parser."""

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "link", "img", "rect", "path", "br"}
HEADINGS = {"h1", "h2", "h3"}


@dataclass
class Page(HTMLParser):
    """What is on a page.

    Attributes:
        tables: the paragraph or heading above → lines of cells, the head first.
        sections: heading → lines of cells of the tables below it, likewise.
        tags: name and attributes of each element, in order.
        words: all text outside of styles.
    """

    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    sections: dict[str, list[list[str]]] = field(default_factory=dict)
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    words: str = ""
    _open: list[str] = field(default_factory=list)
    _above: str = ""
    _line: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.append((tag, values))
        if tag not in VOID:
            self._open.append(tag)
        if tag in {"p", *HEADINGS} and "table" not in self._open:
            self._above = ""
        elif tag == "tr":
            self._line = []
            for lines in (self.tables.setdefault(self._above, []), *[*self.sections.values()][-1:]):
                lines.append(self._line)
        elif tag in ("td", "th"):
            self._line.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag, f"</{tag}> closes another element"
        if tag in HEADINGS:
            self.sections[" ".join(self._above.replace("¶", "").split())] = []

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.words += data
        if "td" in self._open or "th" in self._open:
            self._line[-1] += data
        elif {"p", *HEADINGS} & {*self._open}:
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
