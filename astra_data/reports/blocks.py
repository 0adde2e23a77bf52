"""Pages as blocks, and the two ways to write them: Markdown, and one HTML page that loads nothing.

Texts and cells may hold `code` and **strong** marks; all else is escaped in HTML.
"""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np

from astra_data.reports.statistics import Summary


def table(head: Sequence[str], lines: Iterable[Iterable[str]], *, words: int = 1) -> str:
    """Return a Markdown table whose first `words` columns are aligned left, the others right."""
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def spread(summary: Summary | None, digits: int) -> str:
    """Return mean ± standard deviation; a dash for None."""
    if summary is None:
        return "-"
    deviation = "" if summary.std is None else f" ± {summary.std:.{digits}f}"
    return f"{summary.mean:.{digits}f}{deviation}"


def listed(words: Sequence[str]) -> str:
    """Return words as a list within a sentence."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def interval(value: float, low: float | None, high: float | None, digits: int = 2) -> str:
    """Return a value and, if it has one, its interval."""
    ends = "" if low is None or high is None else f" [{low:.{digits}f}, {high:.{digits}f}]"
    return f"{value:.{digits}f}{ends}"


def measured(value: float, low: float, high: float) -> str:
    """Return a measured value with three significant digits and, if it has one, its interval."""
    return f"{value:.3g}" if np.isnan([low, high]).any() else f"{value:.3g} [{low:.3g}, {high:.3g}]"


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
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


_PIXEL = 2
"""Pixels of a figure for each of the page."""
_SIZE = slice(16, 24)
"""Where a PNG has its width and height."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


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
    """A figure; left out where it was not drawn.

    Attributes:
        name: of its image. title: above it. caption: below it. alt: what it shows, in words.
        photo: it keeps its colors on a dark page.
    """

    name: str
    title: str
    caption: str
    alt: str = ""
    photo: bool = False


Block = Text | Code | TableBlock | Picture


@dataclass(frozen=True)
class Section:
    """Blocks below a heading, which may be empty; `folded` ones are closed at first in HTML."""

    title: str
    blocks: Sequence[Block]
    folded: bool = False


def code(text: str) -> str:
    """Return a text of anybody's as code that ends nowhere within it."""
    return f"`{' '.join(text.replace('`', '').split())}`"


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
    if isinstance(block, Text):
        return "\n\n".join(filter(None, (block.text, "\n".join(f"- {item}" for item in block.items))))
    if isinstance(block, Code):
        return f"```\n{block.text}\n```"
    if isinstance(block, Picture):
        if block.name not in figures:
            return ""
        return f"### {block.title}\n\n![{block.alt or block.title}]({figures[block.name]})\n\n{block.caption}"
    if not block.lines:
        return ""
    lines = [[_cell(cell) for cell in line] for line in block.lines]
    written = table([_cell(cell) for cell in block.head], lines, words=block.words)
    return f"{block.title}:\n\n{written}" if block.title else written


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("<", "&lt;").replace("\n", " ")


def html(title: str, sections: Sequence[Section], images: Mapping[str, bytes] | None = None) -> str:
    """Return the page in HTML, with the PNG `images` of its figures, by name, inside it."""
    shown = images or {}
    bodies = [(section, body) for section in sections if (body := _html_of(section.blocks, shown))]
    named = [(section.title, _anchor(section.title)) for section, _ in bodies if section.title]
    links = "".join(f'<li><a href="#{anchor}">{escape(name)}</a></li>' for name, anchor in named)
    css = files("astra_data.reports").joinpath("results.css").read_text()
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            f"<title>{escape(title)}: results</title>",
            f'<link rel="icon" href="data:,">\n<style>\n{css}</style>\n</head>\n<body>',
            f'<nav aria-label="Sections"><ul>{links}</ul></nav>',
            f'<main class="sheet">\n<h1>{escape(title)}</h1>',
            *(_html_section(section, body) for section, body in bodies),
            "</main>\n</body>\n</html>\n",
        ]
    )


def _html_section(section: Section, body: str) -> str:
    if not section.title:
        return f"<section>\n{body}\n</section>"
    name, anchor = escape(section.title), _anchor(section.title)
    if section.folded:
        return f'<details id="{anchor}">\n<summary>{name}</summary>\n{body}\n</details>'
    return f'<section id="{anchor}">\n<h2>{name}</h2>\n{body}\n</section>'


def _html_of(blocks: Iterable[Block], images: Mapping[str, bytes]) -> str:
    return "\n".join(filter(None, (_html(block, images) for block in blocks)))


def _html(block: Block, images: Mapping[str, bytes]) -> str:
    if isinstance(block, Text):
        items = "".join(f"<li>{inline(item)}</li>" for item in block.items)
        mark = ' class="warning"' if block.warns else ""
        text = f"<p{mark}>{inline(block.text)}</p>" if block.text else ""
        return text + (f"\n<ul>{items}</ul>" if items else "")
    if isinstance(block, Code):
        return f"<pre>{escape(block.text)}</pre>"
    if isinstance(block, Picture):
        return _plate(block, images[block.name]) if block.name in images else ""
    if not block.lines:
        return ""
    heads = [inline(name) for name in block.head]
    labels = [escape(re.sub(r"[`*]", "", name)) for name in block.head]
    head = "".join(f'<th scope="col"{_word(block, at)}>{name}</th>' for at, name in enumerate(heads))
    lines = "\n".join(_line(block, line, labels) for line in block.lines)
    caption = f"<caption>{inline(block.title)}</caption>" if block.title else ""
    label = re.sub(r"[`*]", "", block.title) or "TableBlock"
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(label)}">\n<table>{caption}\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}\n</tbody>\n</table>\n</div>"
    )


def _line(block: TableBlock, line: Sequence[str], labels: Sequence[str]) -> str:
    cells = "".join(
        f'<td{_word(block, at)} data-label="{label}">{inline(cell)}</td>'
        for at, (cell, label) in enumerate(zip(line, labels, strict=True))
        if at
    )
    return f'<tr><th scope="row">{inline(line[0])}</th>{cells}</tr>'


def _word(block: TableBlock, at: int) -> str:
    return ' class="word"' if 0 < at < block.words else ""


def _plate(block: Picture, image: bytes) -> str:
    size = image[_SIZE]
    width, height = (int.from_bytes(of) // _PIXEL for of in (size[:4], size[4:]))
    source = f"data:image/png;base64,{b64encode(image).decode()}"
    mark, alt = ' class="photo"' if block.photo else "", escape(block.alt or block.title)
    return (
        f'<figure>\n<div class="plate" role="region" tabindex="0" aria-label="{escape(block.title)}">'
        f'<img{mark} src="{source}" width="{width}" height="{height}" alt="{alt}">'
        f"</div>\n<figcaption><strong>{inline(block.title)}.</strong> "
        f"{inline(block.caption)}</figcaption>\n</figure>"
    )


def inline(text: str) -> str:
    """Return a text as HTML: `code` and **strong**, all else escaped."""
    marked = re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", marked)


def _anchor(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower()).strip("-")
