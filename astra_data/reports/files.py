"""Results as files: JSON, the page, and figures."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from astra_data.core.config import faults_of
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.wording import first_few
from astra_data.reports.schema import Results
from astra_data.reports.sizes import SizesResults, points_of

Found = Results | SizesResults
Page = Callable[[Mapping[str, str]], str]
"""Name → file name of each figure → the page."""

FIGURES = (
    *("success", "steps", "return", "trajectories", "strips", "mismatch"),
    *("learning", "learning_steps", "gap", "validity", "data_efficiency"),
)
"""Names of all figures that a page can have."""


def read_published(path: Path) -> Found:
    """Read results from a JSON file.

    Raises:
        BadInputError: the file is missing, or has another layout.
    """
    if not path.is_file():
        raise BadInputError(f"expected published results in {path}, found none: leave out what asks for them")
    try:
        return TypeAdapter[Found](Found).validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadInputError(
            f"{path} does not hold results in the current format: {faults_of(error)}"
        ) from None


def published_figures(folder: Path, recipe: str) -> dict[str, bytes]:
    """Return the figures of a recipe that are in `folder`, by name."""
    paths = {name: folder / f"{recipe}_{name}.png" for name in FIGURES}
    return {name: path.read_bytes() for name, path in paths.items() if path.exists()}


def check_none_lost(found: Found, folder: Path) -> None:
    """Refuse to publish results in `folder` in place of ones that have more rows or seeds.

    Raises:
        BadInputError: rows or seeds would be lost.
    """
    path = folder / f"{found.recipe}.json"
    if not path.exists():
        return
    kept = points_of(found)
    lost = [
        f"{name} of seed {seed}"
        for percent, name, seed in points_of(read_published(path))
        if (percent, name, seed) not in kept
    ]
    if lost:
        raise BadInputError(
            f"{path}: expected all of its rows and seeds in the results that replace it, got none for "
            f"{first_few([*dict.fromkeys(lost)], 4)}: use --add to keep them, or delete the file to publish "
            "without them"
        )


def publish_results(found: Found, page: Page, images: dict[str, bytes], folder: Path) -> None:
    """Write page, JSON and `images` to `folder` under the recipe's name, replacing earlier ones."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        (folder / f"{found.recipe}_{name}.png").unlink(missing_ok=True)
    write_results(found, page, images, folder, found.recipe, f"{found.recipe}_")


def write_results(
    found: Found, page: Page, images: dict[str, bytes], folder: Path, stem: str, prefix: str = ""
) -> None:
    """Write `stem`.json, `stem`.md and the PNG `images`, each with `prefix` before its name."""
    names = {name: f"{prefix}{name}.png" for name in images}
    write_file(folder / f"{stem}.json", _json(found))
    write_file(folder / f"{stem}.md", page(names))
    for name, image in images.items():
        write_file(folder / names[name], image)


def _json(results: Found) -> str:
    """Return indented JSON in which a list of numbers or texts takes one line."""
    values = json.loads(results.model_dump_json(by_alias=True))
    text = json.dumps(values, indent=2, ensure_ascii=False)
    return re.sub(r"\[\n[^\[\]{}]*\]", lambda found: re.sub(r"\n *", " ", found[0]), text) + "\n"
