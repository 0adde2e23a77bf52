"""The recipes that come with the package, with the examples that they name."""

import re
import shutil
import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError

_PACKAGE = Path(__file__).resolve().parents[1]

RECIPES = next(folder for folder in (_PACKAGE / "recipes", _PACKAGE.parent / "recipes") if folder.is_dir())
"""The folder of recipes: in the installed package, or beside it in a checkout."""

IMPORTS = "imports"
"""The folder of mappings, below `RECIPES`."""

START_HERE = ("quickstart", "cart", "antmaze_quick")
"""Recipes to begin with, the first first."""
_EXAMPLES = "Examples: your own robot, data and methods"
_ROBOTS = {"antmaze": "An ant in mazes", "nao": "A humanoid robot, NAO", "humanoid": "A simulated humanoid"}
"""Titles of groups, by the beginnings of tasks."""
_DURATION = re.compile(r"About (\d+ \w+( per seed)?)( on [^.]*)?\.")
_COMMAND = re.compile(r"(uv run |astra-data |python |--)")


@dataclass(frozen=True)
class ShippedRecipe:
    """A recipe that comes with the package.

    Attributes:
        path: of its file, below `RECIPES`.
        table: its content.
        about: what its first comments say.
    """

    path: Path
    table: dict[str, Any]
    about: str

    @property
    def name(self) -> str:
        """Its file's name, without the ending."""
        return self.path.stem

    @property
    def task(self) -> str:
        """The task that it names, or that what it is based on names; empty where there is none."""
        if base := self.table.get("based_on"):
            return str(self.table.get("task", shipped(base).task))
        return str(self.table.get("task", ""))

    @property
    def group(self) -> str:
        """The title under which it is listed."""
        if self.path.parts[0] == IMPORTS:
            return "Mappings, for astra-data import LOGS --mapping"
        if self.name in START_HERE:
            return "Start here"
        return _ROBOTS.get(self.task.partition("-")[0], _EXAMPLES)

    @property
    def duration(self) -> str:
        """How long it takes, as its first comments say: without that, how much there is to train."""
        if found := _DURATION.search(self.about):
            return found[1]
        base = shipped(self.table["based_on"]).table if "based_on" in self.table else {}
        table = base | self.table
        counts = [len(table.get(key, ())) for key in ("methods", "seeds")]
        return f"hours ({counts[0]} rows, {counts[1]} seeds)" if all(counts) else ""

    @property
    def summary(self) -> str:
        """What it is, in a sentence."""
        return _DURATION.sub("", self.about).partition(". ")[0].strip().rstrip(".")

    @property
    def files(self) -> set[Path]:
        """The files that it needs, below `RECIPES`: its base, code, and what its head names."""
        files = {self.path}
        if base := self.table.get("based_on"):
            files |= shipped(base).files
        folders = [RECIPES / self.path.parent]
        place = folders[0] / str(self.table.get("task", "")).partition(":")[0]
        if place.is_file():
            files.add(place.resolve().relative_to(RECIPES))
            folders.append(place.resolve().parent)
        text = (RECIPES / self.path).read_text().partition("\n\n")[0]
        named = {Path(name) for name in re.findall(r"recipes/(\S+\.(?:py|toml))", text)}
        files |= {path for path in named if (RECIPES / path).is_file()}
        return files | {code.relative_to(RECIPES) for folder in folders for code in folder.glob("*.py")}


@cache
def shipped_recipes() -> tuple[ShippedRecipe, ...]:
    """Return all recipes, by name."""
    texts = {path.relative_to(RECIPES): path.read_text() for path in RECIPES.rglob("*.toml")}
    found = [ShippedRecipe(path, tomllib.loads(text), _about(text)) for path, text in texts.items()]
    runnable = {"methods", "based_on"}
    kept = [recipe for recipe in found if not runnable.isdisjoint(recipe.table)]
    return tuple(sorted(kept, key=lambda recipe: recipe.name))


@cache
def shipped_mappings() -> tuple[ShippedRecipe, ...]:
    """Return all mappings of `import`, by name."""
    texts = {path.relative_to(RECIPES): path.read_text() for path in (RECIPES / IMPORTS).glob("*.toml")}
    found = [ShippedRecipe(path, tomllib.loads(text), _about(text)) for path, text in texts.items()]
    return tuple(sorted(found, key=lambda mapping: mapping.name))


def listed() -> dict[str, list[ShippedRecipe]]:
    """Return all recipes and mappings by the titles of their groups, what to begin with first."""
    groups: dict[str, list[ShippedRecipe]] = {title: [] for title in ("Start here", _EXAMPLES)}
    for recipe in (*shipped_recipes(), *shipped_mappings()):
        groups.setdefault(recipe.group, []).append(recipe)
    groups["Start here"].sort(key=lambda recipe: START_HERE.index(recipe.name))
    return groups


def shipped(name: str) -> ShippedRecipe:
    """Return the recipe, or the mapping, of this name.

    Raises:
        BadInputError: there is none.
    """
    recipes = {recipe.name: recipe for recipe in (*shipped_mappings(), *shipped_recipes())}
    if name not in recipes:
        raise BadInputError(f"no recipe '{name}' comes with astra-data{did_you_mean(name, recipes)}")
    return recipes[name]


def whereabouts(name: str) -> str:
    """Return where the recipe of a name, or of one like it, is, or how to get it; "" if none is alike."""
    recipes = {recipe.name: recipe for recipe in shipped_recipes()}
    for found in get_close_matches(name, recipes, n=1):
        place = Path(RECIPES.name) / recipes[found].path
        how = f"`astra-data recipes copy {found}` writes {place}"
        return f"did you mean {place}?" if place.is_file() else how
    return ""


def copy_recipe(name: str, folder: Path) -> list[Path]:
    """Copy a recipe and what it needs to `folder`; return the new files.

    Files that are there with the same bytes stay.

    Raises:
        BadInputError: there is no such recipe, or a file is there with other bytes.
    """
    places = {RECIPES / path: folder / path for path in sorted(shipped(name).files)}
    for source, place in places.items():
        if place.exists() and (not place.is_file() or place.read_bytes() != source.read_bytes()):
            raise BadInputError(
                f"{place} exists and differs from the one in the package: choose another folder"
            )
    new = {place: source for source, place in places.items() if not place.exists()}
    for place, source in new.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
    return list(new)


def _about(text: str) -> str:
    """Return what the first comments say below the commands that run the recipe."""
    lines = text.partition("\n\n")[0].splitlines()
    comments = [line.removeprefix("#").strip() for line in lines if line.startswith("#")]
    commands = [number for number, line in enumerate(comments) if _COMMAND.match(line)]
    return " ".join(comments[max(commands, default=-1) + 1 :]).strip()
