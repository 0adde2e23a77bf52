"""Pages as blocks, with `code` and **strong** marks in texts, as Markdown or as one HTML page that loads nothing."""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

_PIXEL = 2  # pixels of a figure for each of the page


@dataclass(frozen=True)
class Text:
    """A paragraph, or with `items` a list below it; `warns` where it is to be seen first."""

    text: str
    items: Sequence[str] = ()
    warns: bool = False


@dataclass(frozen=True)
class Code:
    """Lines to be copied."""

    text: str


@dataclass(frozen=True)
class TableBlock:
    """A table whose first `words` columns are text."""

    title: str
    head: Sequence[str]
    lines: Sequence[Sequence[str]]
    words: int = 1


@dataclass(frozen=True)
class Picture:
    """A figure by the name of its image, left out where it was not drawn; a `photo` keeps its colors."""

    name: str
    title: str
    caption: str
    photo: bool = False


Block = Text | Code | TableBlock | Picture


@dataclass(frozen=True)
class Section:
    """Blocks below a heading, which may be empty; `folded` ones are closed at first in HTML."""

    title: str
    blocks: Sequence[Block]
    folded: bool = False


def table(head: Sequence[str], lines: Iterable[Iterable[str]], *, words: int = 1) -> str:
    """Return a Markdown table whose first `words` columns are aligned left, the others right."""
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def listed(words: Sequence[str]) -> str:
    """Return words as a list within a sentence."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def short(rate: float) -> str:
    """Return a rate with three significant digits, in thousands from 1000 on, then in millions."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if rate >= 0.9995 * size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g}"


def duration(seconds: float | None) -> str:
    """Return a time in seconds, minutes or hours; a dash for None."""
    if seconds is None:
        return "-"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def markdown(title: str, sections: Sequence[Section], figures: Mapping[str, str] | None = None) -> str:
    """Return the page in Markdown; `figures` are the file names of the figures that were drawn, by name."""
    parts = [f"# {title}"]
    for section in sections:
        written = [text for block in section.blocks if (text := _markdown(block, figures or {}))]
        if written:
            parts += [f"## {section.title}"] if section.title else []
            parts += written
    return "\n\n".join(parts) + "\n"


def _markdown(block: Block, figures: Mapping[str, str]) -> str:
    match block:
        case Text():
            return "\n\n".join(filter(None, (block.text, "\n".join(f"- {item}" for item in block.items))))
        case Code():
            return f"```\n{block.text}\n```"
        case Picture() if block.name in figures:
            return f"### {block.title}\n\n![{block.title}]({figures[block.name]})\n\n{block.caption}"
        case TableBlock() if block.lines:
            head, *lines = [
                [cell.replace("|", r"\|").replace("<", "&lt;").replace("\n", " ") for cell in line]
                for line in (block.head, *block.lines)
            ]
            return (f"{block.title}:\n\n" if block.title else "") + table(head, lines, words=block.words)
    return ""


def html(title: str, sections: Sequence[Section], images: Mapping[str, bytes] | None = None) -> str:
    """Return the page in HTML, with the PNG `images` of its figures, by name, inside it."""
    bodies = ("\n".join(filter(None, (_html(block, images or {}) for block in section.blocks))) for section in sections)
    written = [(section, body) for section, body in zip(sections, bodies, strict=True) if body]
    links = "".join(
        f'<li><a href="#{_anchor(section)}">{escape(section.title)}</a></li>' for section, _ in written if section.title
    )
    folder = files("astra_data.reports")
    return (
        (folder / "results.html.template")
        .read_text(encoding="utf-8")
        .format(
            title=escape(title),
            css=(folder / "results.css").read_text(encoding="utf-8"),
            links=links,
            body="\n".join(_html_section(section, body) for section, body in written),
        )
    )


def _html_section(section: Section, body: str) -> str:
    name, anchor = escape(section.title), _anchor(section)
    if not name:
        return f"<section>\n{body}\n</section>"
    if section.folded:
        return f'<details id="{anchor}">\n<summary>{name}</summary>\n{body}\n</details>'
    return f'<section id="{anchor}">\n<h2>{name}</h2>\n{body}\n</section>'


def _anchor(section: Section) -> str:
    return re.sub(r"\W+", "-", section.title.lower()).strip("-")


def _html(block: Block, images: Mapping[str, bytes]) -> str:
    match block:
        case Text():
            items = "".join(f"<li>{inline(item)}</li>" for item in block.items)
            mark = ' class="warning"' if block.warns else ""
            text = f"<p{mark}>{inline(block.text)}</p>" if block.text else ""
            return text + (f"\n<ul>{items}</ul>" if items else "")
        case Code():
            return f"<pre>{escape(block.text)}</pre>"
        case Picture() if block.name in images:
            return _html_picture(block, images[block.name])
        case TableBlock() if block.lines:
            return _html_table(block)
    return ""


def _html_table(block: TableBlock) -> str:
    labels = [escape(re.sub(r"[`*]", "", name)) for name in (block.title or "TableBlock", *block.head)]
    words = ["", *[' class="word"'] * (block.words - 1), *[""] * len(block.head)]
    head = "".join(f'<th scope="col"{word}>{inline(name)}</th>' for name, word in zip(block.head, words, strict=False))
    lines = ""
    for first, *others in block.lines:
        cells = "".join(
            f'<td{word} data-label="{label}">{inline(cell)}</td>'
            for cell, label, word in zip(others, labels[2:], words[1:], strict=False)
        )
        lines += f'<tr><th scope="row">{inline(first)}</th>{cells}</tr>\n'
    caption = f"<caption>{inline(block.title)}</caption>" if block.title else ""
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{labels[0]}">\n<table>{caption}\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}</tbody>\n</table>\n</div>"
    )


def _html_picture(block: Picture, image: bytes) -> str:
    width, height = (int.from_bytes(image[at : at + 4]) // _PIXEL for at in (16, 20))  # where a PNG has them
    source = f"data:image/png;base64,{b64encode(image).decode()}"
    mark, title = ' class="photo"' if block.photo else "", escape(block.title)
    return (
        f'<figure>\n<div class="plate" role="region" tabindex="0" aria-label="{title}">'
        f'<img{mark} src="{source}" width="{width}" height="{height}" alt="{title}">'
        f"</div>\n<figcaption><strong>{inline(block.title)}.</strong> {inline(block.caption)}</figcaption>\n</figure>"
    )


def inline(text: str) -> str:
    """Return a text as HTML: `code` and **strong**, all else escaped."""
    marked = re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", marked)
