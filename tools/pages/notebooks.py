"""Notebooks as pages: their text, and cells of code with what they printed and drew."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def notebook_page(path: Path) -> str:
    """Return the page of a notebook, with a link to its file, which lies beside the page's folder."""
    cells = json.loads(path.read_text())["cells"]
    title, *rest = ("\n\n".join(_parts(cell)) for cell in cells)
    place = f"`docs/guide/notebooks/{path.name}` of a checkout"
    link = f'<a href="../{path.name}" download>Download this notebook</a>, {place}.'
    return "\n\n".join([title, link, *rest]) + "\n"


def notebook_text(path: Path) -> str:
    """Return what is written between the cells of code."""
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def _parts(cell: dict[str, Any]) -> Iterator[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield _fenced("python", source)
    for output in cell["outputs"]:
        if output["output_type"] == "stream":
            yield _fenced("text", "".join(output["text"]))
        elif (picture := output["data"].get("image/png")) is not None:
            yield f"![What the cell draws](data:image/png;base64,{picture})"
        else:
            yield _fenced("text", "".join(output["data"]["text/plain"]))


def _fenced(language: str, text: str) -> str:
    fence = "````" if "```" in text else "```"
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"
