"""Experiments: a recipe, the folder of its artifacts, and the recipe that it is based on, if any.

    based_on = "antmaze_umaze"

A recipe with this line lists only the differences from the recipe of that name beside it. Stages without a
difference are not run again: links in its folder lead to the other recipe's artifacts. It may have another
task with the same target; then it shares the collected episodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from astra_data.core.config import did_you_mean, validated
from astra_data.core.durable import begun_beside, made_in
from astra_data.core.errors import RecipeError
from astra_data.core.naming import RECORD, base_method, reference_of, stage_of_key
from astra_data.methods import method_named
from astra_data.pipeline.changed_settings import differences, restated, share_target
from astra_data.pipeline.recipe import Recipe, read_tables, recorded_settings
from astra_data.pipeline.stages.registry import STAGES
from astra_data.pipeline.staleness import ROWS_TABLES, reads, stale_stages
from astra_data.pipeline.user_code import changed_code
from astra_data.reports.results import read_results

ALWAYS_NEW = {"report"}
"""Made by every run: it is cheap, and shows the rows and seeds that the recipe has now."""


@dataclass(frozen=True)
class Experiment:
    """A recipe and where its artifacts are.

    Attributes:
        recipe: with what it takes from its base.
        path: the recipe's file. folder: of its artifacts.
        base: the experiment that this one is based on, if any.
    """

    recipe: Recipe
    path: Path
    folder: Path
    base: "Experiment | None" = None

    @cached_property
    def borrowed(self) -> set[str]:
        """The stages whose artifacts are taken from the base."""
        if self.base is None:
            return set()
        changed = {*differences(self.base.recipe.settings, self.recipe)}
        absent = set() if self.recipe.sweep.percent else {"subset"}
        asked = {stage.name: stage.asked_by for stage in STAGES.values() if stage.asked_by}
        absent |= {stage for stage, key in asked.items() if not getattr(self.recipe, key)}
        sizes, theirs = (set(one.sweep.percent) for one in (self.recipe, self.base.recipe))
        begun = {"subset"} if bool(sizes) != bool(theirs) or not sizes <= theirs else set[str]()
        own = restated(self.base.recipe.settings, self.recipe)
        begun |= {method_named(name).configures for name in own}
        return STAGES.keys() - ALWAYS_NEW - absent - stale_stages(changed, begun)

    def maker(self, stage: str) -> "Experiment":
        """Return the experiment that makes the artifacts of `stage`."""
        return self.base if self.base and stage in self.borrowed else self

    def place(self, key: str) -> Path:
        """Return the folder of the artifact `key`."""
        return self.maker(stage_of_key(key)).folder / key

    def has(self, key: str) -> bool:
        """Return whether the artifact `key` is finished."""
        stage = stage_of_key(key)
        return self.place(key).is_dir() and not self.maker(stage)._is_link(stage)

    def _is_link(self, stage: str) -> bool:
        """Return whether a stage's folder is a link to another recipe's, from this run or an earlier one."""
        link = self.folder / stage
        return link.is_symlink() and link.readlink().parent.parent == Path("..")

    def link_borrowed(self) -> None:
        """Link the folders of borrowed stages to the base's.

        Raises:
            RecipeError: a link would replace artifacts.
        """
        for stage in STAGES:
            link = self.folder / stage
            if self._is_link(stage):
                link.unlink()
            if stage not in self.borrowed:
                continue
            source = self.maker(stage).folder
            if link.exists() or link.is_symlink():
                raise RecipeError(
                    f"{link} is in the way: {self.path} is based on {source.name}, whose {stage} it uses; "
                    f"give the recipe another name, or remove {link}"
                )
            link.symlink_to(Path("..") / source.name / stage)

    def check_unchanged(self) -> None:
        """Refuse settings that differ from those of existing artifacts, finished or not.

        Raises:
            RecipeError: they differ, here or in the base.
        """
        if self.base:
            self.base.check_unchanged()
        changed, folders = self._outdated
        if folders:
            raise RecipeError(
                f"{changed} since {self.folder} was made: "
                f"give the recipe another name, or remove {' '.join(map(str, folders))}"
            )

    def outdated(self, key: str) -> str:
        """Return which settings changed since the artifact `key` was made, or begun; empty if none."""
        changed, folders = self.maker(stage_of_key(key))._outdated
        places = [self.place(key)] if self.has(key) else begun_beside(self.place(key))
        if not any(place.is_relative_to(folder) for place in places for folder in folders):
            return ""
        this = "this" if self.has(key) else " ".join(map(str, places))
        return f"{changed} since: give the recipe another name, or remove {this}"

    @cached_property
    def _outdated(self) -> tuple[str, list[Path]]:
        """What changed since the artifacts were made, and the folders made or begun with the old."""
        if not (self.folder / RECORD).is_file():
            return "", []
        recorded = recorded_settings(self.folder)
        for key in ("task", "data"):
            now = getattr(self.recipe, key)
            if _is_same_place(recorded.get(key), now):
                recorded[key] = now
        changes = differences(recorded, self.recipe)
        changed = changes.keys()
        code = changed_code(self.recipe, self.folder)
        whole = stale_stages((changed - ROWS_TABLES) | ({"task"} & code.keys()))
        own = STAGES.keys() - self.borrowed - ALWAYS_NEW
        own = {stage for stage in own if (self.folder / stage).exists() and not self._is_link(stage)}
        folders = [self.folder / stage for stage in STAGES if stage in whole & own]
        for table in sorted(changed & ROWS_TABLES):
            for stage in sorted((stale_stages({table}) - whole) & own):
                folders += self._rows_of(table, stage)
        rows = [place for stage in sorted(own - whole) for place in sorted((self.folder / stage).iterdir())]
        folders += [row for row in rows if base_method(row.name) in code]
        tables = " and ".join(f"{table} ({how})" for table, how in sorted(changes.items()))
        texts = [f"{tables} changed in the recipe"] if tables else []
        texts += [f"{what} changed" for what in dict.fromkeys(code.values())]
        outermost = [folder for folder in dict.fromkeys(folders) if folder.parent not in folders]
        return " and ".join(texts), [made for folder in outermost for made in made_in(folder, "seed_*")]

    @property
    def results(self) -> Path:
        """The folder of published results."""
        return self.path.parent / "results"

    def published(self) -> list[Path]:
        """Return the files of published results that those of this recipe are added to.

        They are its own and, if it borrows the evaluations, the base's, as far as they are there.

        Raises:
            BadInputError: one does not hold results.
            RecipeError: they were made with other settings.
        """
        names = dict.fromkeys((self.maker("evaluate").path.stem, self.path.stem))
        files = [file for name in names if (file := self.results / f"{name}.json").exists()]
        for file in files:
            found = read_results(file)
            changed = differences(found.settings, self.recipe).keys() - ALWAYS_NEW - {"select"}
            tested = {*found.tested(), *filter(None, [reference_of(self.recipe.methods)])}
            changed -= {table for table in ROWS_TABLES if not any(reads(row, table) for row in tested)}
            own = restated(found.settings, self.recipe) & {*map(base_method, tested)}
            changed |= {f"own_methods.{name}" for name in own}
            if changed:
                raise RecipeError(
                    f"{' and '.join(sorted(changed))} changed in {self.path} since the results in {file} "
                    "were made: move them away to publish the new ones without them"
                )
        return files

    def _rows_of(self, table: str, stage: str) -> list[Path]:
        """Return the folders in `stage` of the rows that depend on `table`; its own where all do."""
        folder = self.folder / stage
        if stage == "select":  # it has no rows; that it is of other policies is told by digests
            return [folder] if table == "ground" else []
        rows = sorted(folder.iterdir())
        # An evaluation may be of a time when the recipe had the reference.
        grounded = (place.name for place in (self.folder / "ground").glob("*"))
        reference = reference_of([*self.recipe.methods, *grounded]) if stage == "evaluate" else None
        if reference and reads(reference, table):
            return [folder]
        found = [row for row in rows if reads(row.name, table)]
        return [folder] if found == rows else found


def load_experiment(path: Path, root: Path) -> Experiment:
    """Read the recipe at `path`, whose artifacts are in a folder of its name in `root`.

    Raises:
        RecipeError: it, or the recipe that it is based on, has faults, or they do not fit each other.
    """
    tables = read_tables(path)
    folder = root / path.stem
    if "based_on" not in tables:
        return Experiment(validated(tables, Recipe, str(path)), path, folder)
    name = tables["based_on"]
    known = sorted({file.stem for file in path.parent.glob("*.toml")} - {path.stem})
    if name not in known:
        raise RecipeError(f"{path}: based_on: unknown recipe '{name}'{did_you_mean(str(name), known)}")
    base_path = path.with_name(f"{name}.toml")
    base_tables = read_tables(base_path)
    if "based_on" in base_tables:
        raise RecipeError(f"{path}: based_on: expected a recipe that is not based on another, got '{name}'")
    base = Experiment(validated(base_tables, Recipe, str(base_path)), base_path, root / base_path.stem)
    recipe = validated(_laid_over(base_tables, tables), Recipe, str(path))
    _check_fit(recipe, base, path)
    return Experiment(recipe, path, folder, base)


def _is_same_place(before: object, now: object) -> bool:
    """Return whether two names of a file or folder of the user's, told from different folders, may be of one.

    Whether it holds what it held then is told by digests: of code in code.json, of data as of artifacts.
    """
    file, is_code, _ = str(now).partition(".py:")
    there = Path(f"{file}.py").is_file() if is_code else Path(file).is_dir()
    return there and Path(str(before)).name == Path(str(now)).name


def _laid_over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a recipe over those of its base; `data` and `[collect]` replace each other."""
    other = {"data": "collect", "collect": "data"}
    replaced = {other[key] for key in other.keys() & above.keys()} - above.keys()
    below = {key: value for key, value in below.items() if key not in replaced}

    def both(key: str) -> Any:  # noqa: ANN401 - any value of a recipe
        old, new = below[key], above[key]
        return old | new if isinstance(old, dict) and isinstance(new, dict) else new

    return below | {key: both(key) if key in below else value for key, value in above.items()}


def _check_fit(recipe: Recipe, base: Experiment, path: Path) -> None:
    name, faults = base.path.stem, []
    if recipe.task != base.recipe.task and not share_target(base.recipe.task, recipe.task):
        faults.append(
            f"task: expected that of {name}, '{base.recipe.task}', or one with the same target, "
            f"got '{recipe.task}'"
        )
    for key in ("methods", "seeds"):
        theirs, ours = getattr(base.recipe, key), getattr(recipe, key)
        unknown = [value for value in ours if value not in theirs]
        advice = f"add it to those of {base.path} and run that, or leave out based_on"
        faults += [f"{key}: {name} has no '{value}', it has {list(theirs)}: {advice}" for value in unknown]
    if faults:
        raise RecipeError(f"{path} does not fit what it is based on: {'; '.join(faults)}")
