"""The recipes that come with the package, with the examples that they name."""

import re
import shutil
import tomllib
from difflib import get_close_matches
from functools import cache
from pathlib import Path

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError

_PACKAGE = Path(__file__).resolve().parents[1]

RECIPES = next(folder for folder in (_PACKAGE / "recipes", _PACKAGE.parent / "recipes") if folder.is_dir())
"""The folder of recipes: in the installed package, or beside it in a checkout."""

IMPORTS = "imports"  # the folder of mappings, below `RECIPES`

START_HERE = ("quickstart", "cart", "antmaze_quick")  # recipes to begin with
_COMMAND = re.compile(r"(uv run |astra-data |python |--)")


class ShippedRecipe:
    """A recipe or a mapping that comes with the package, at a `path` below `RECIPES`."""

    def __init__(self, path: Path) -> None:
        text = (RECIPES / path).read_text()
        self.path, self.name, self.table = path, path.stem, tomllib.loads(text)
        self.head = text.partition("\n\n")[0]
        lines = [line.removeprefix("#").strip() for line in self.head.splitlines() if line.startswith("#")]
        commands = [number for number, line in enumerate(lines) if _COMMAND.match(line)]
        self.about = " ".join(lines[max(commands, default=-1) + 1 :]).strip()
        """What its first comments say below the commands that run it."""
        self.is_mapping = path.parts[0] == IMPORTS

    @property
    def base(self) -> "ShippedRecipe | None":
        """The recipe that it is based on."""
        return shipped(self.table["based_on"]) if "based_on" in self.table else None

    @property
    def task(self) -> str:
        """The task that it names, or that what it is based on names; empty where there is none."""
        return str(self.table.get("task", self.base.task if self.base else ""))

    @property
    def files(self) -> set[Path]:
        """The files that it needs, below `RECIPES`: its base, code, and what its head names."""
        folders = [RECIPES / self.path.parent]
        for own in (self.table.get("task", ""), *self.table.get("user_methods", {}).values()):
            place = folders[0] / (own if isinstance(own, str) else own["method"]).partition(":")[0]
            folders += [place.resolve().parent] if place.is_file() else []
        named = {Path(name) for name in re.findall(r"recipes/(\S+\.(?:py|toml))", self.head)}
        found = {self.path, *(path for path in named if (RECIPES / path).is_file())}
        found |= {code.relative_to(RECIPES) for folder in folders for code in folder.glob("*.py")}
        return found | (self.base.files if self.base else set())


@cache
def shipped_recipes() -> tuple[ShippedRecipe, ...]:
    """Return all recipes, and mappings of `import`, by name."""
    found = [ShippedRecipe(path.relative_to(RECIPES)) for path in RECIPES.rglob("*.toml")]
    kept = [one for one in found if {"methods", "based_on"} & one.table.keys() or one.is_mapping]
    return tuple(sorted(kept, key=lambda one: one.name))


def shipped(name: str) -> ShippedRecipe:
    """Return the recipe, or the mapping, of this name."""
    recipes = {recipe.name: recipe for recipe in shipped_recipes()}
    if name not in recipes:
        raise BadInputError(f"no recipe '{name}' comes with astra-data{did_you_mean(name, recipes)}")
    return recipes[name]


def whereabouts(name: str) -> str:
    """Return where the recipe of a name, or of one like it, is, or how to get it; "" if none is alike."""
    recipes = {recipe.name: recipe for recipe in shipped_recipes() if not recipe.is_mapping}
    if not (alike := get_close_matches(name, recipes, n=1)):
        return ""
    place = Path(RECIPES.name) / recipes[alike[0]].path
    return f"did you mean {place}?" if place.is_file() else f"`astra-data recipes copy {alike[0]}` writes {place}"


def is_shipped(place: str) -> bool:
    """Return whether the task at a `place`, such as cart.py:TASK, is that of a recipe or a copy of it."""
    from astra_data.worlds.user_code import code_digest

    tasks = {str(RECIPES / recipe.path.parent / recipe.task) for recipe in shipped_recipes()}
    alike = [task for task in tasks if Path(task).name == Path(place).name]
    return any(code_digest(task) == code_digest(place) for task in alike)


def copy_recipe(name: str, folder: Path) -> list[Path]:
    """Copy a recipe and what it needs to `folder`; return the new files. Those that are there, the same, stay."""
    places = {RECIPES / path: folder / path for path in sorted(shipped(name).files)}
    for source, place in places.items():
        if place.exists() and (not place.is_file() or place.read_bytes() != source.read_bytes()):
            raise BadInputError(f"{place} exists and differs from the one in the package: choose another folder")
    new = {place: source for source, place in places.items() if not place.exists()}
    for place, source in new.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
    return list(new)
