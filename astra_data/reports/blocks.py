"""Pages as blocks, as Markdown or as one HTML page that loads nothing."""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import pairwise

from markdown_it import MarkdownIt

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
    """A figure by the name of its image, left out where it was not drawn."""

    name: str
    title: str
    caption: str


Block = Text | Code | TableBlock | Picture


@dataclass(frozen=True)
class Section:
    """Blocks below a heading, which may be empty."""

    title: str
    blocks: Sequence[Block]


def table(head: Sequence[str], lines: Iterable[Iterable[str]], *, words: int = 1) -> str:
    """Return a Markdown table whose first `words` columns are aligned left, the others right."""
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def listed(words: Sequence[str]) -> str:
    """Return words as a list within a sentence."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


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
            text = f"> {block.text}" if block.warns else block.text
            return "\n\n".join(filter(None, (text, "\n".join(f"- {item}" for item in block.items))))
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
    shown = images or {}
    reader = MarkdownIt("commonmark", {"html": False}).enable("table").disable(["link", "autolink"])
    tokens = reader.parse(markdown(title, sections, {name: name for name in shown}))
    links = ""
    for opening, token in pairwise(tokens):
        if opening.type == "heading_open" and opening.tag == "h2":
            anchor = re.sub(r"\W+", "-", token.content.lower()).strip("-")
            opening.attrSet("id", anchor)
            links += f'<li><a href="#{anchor}">{escape(token.content)}</a></li>'
        for part in token.children or ():
            if part.type == "image" and (image := shown.get(str(part.attrs["src"]))):
                part.attrSet("src", f"data:image/png;base64,{b64encode(image).decode()}")
                part.attrSet("width", f"{int.from_bytes(image[16:20]) // _PIXEL}")  # where a PNG has it
    names, body = ("results.html.template", "results.css"), reader.renderer.render(tokens, reader.options, {})
    page, css = ((files("astra_data.reports") / name).read_text(encoding="utf-8") for name in names)
    return page.format(title=escape(title), css=css, links=links, body=body)
