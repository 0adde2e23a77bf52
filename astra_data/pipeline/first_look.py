"""What is wrong with a recipe or a request, told before anything slow is loaded.

Names are compared with lists, and keys with the sources of the models, which are not run. What this lets pass
is checked in full later.
"""

import ast
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import METHOD_NAMES, TASK_NAMES, base_method

TABLES = {
    "collect": ("astra_data.pipeline.stages.collect:CollectConfig",),
    "augment": ("astra_data.pipeline.stages.augment:AugmentConfig",),
    "pair": ("astra_data.pipeline.stages.pair:PairConfig",),
    "ground": ("astra_data.grounding.fit:GroundConfig",),
    "train": ("astra_data.policies.train:PpoTrainConfig", "astra_data.policies.train:SacTrainConfig"),
    "align": ("astra_data.pipeline.stages.align:AlignConfig",),
    "select": ("astra_data.pipeline.stages.select:SelectConfig",),
    "evaluate": ("astra_data.pipeline.stages.evaluate:EvaluateConfig",),
    "report": ("astra_data.pipeline.stages.report:ReportConfig",),
    "sweep": ("astra_data.pipeline.recipe:SweepConfig",),
    "rma": ("astra_data.policies.rma:RmaConfig",),
    "target": ("astra_data.policies.train:TargetConfig",),
    "iql": ("astra_data.policies.iql:IqlConfig",),
}
"""The tables of recipes, and where the models of their settings are; one model of several has all keys."""
ENGINES = ("processes", "ray")
"""What runs a recipe's items, by name: see `executors.EXECUTORS`."""
KEYS = ("task", "data", "own_methods", "methods", "seeds", "based_on")
"""The keys of recipes beside these."""


def check_names(path: Path) -> None:
    """Refuse unknown tasks, methods, tables and keys in the recipe at `path`; what is no recipe passes.

    Raises:
        RecipeError: it has some; lists them all.
    """
    from astra_data.core.config import did_you_mean, load_tables
    from astra_data.worlds.user_code import is_user_code, offered

    tables = load_tables(path)
    if "methods" not in tables and "based_on" not in tables:
        return
    own = tables.get("own_methods")
    added = {*(own if isinstance(own, dict) else ()), *offered("astra_data.methods")}
    known, faults = (*KEYS, *TABLES, *added), list[str]()
    task, rows = tables.get("task"), tables.get("methods")
    tasks = (*TASK_NAMES, *offered("astra_data.tasks"))
    if isinstance(task, str) and not is_user_code(task) and task not in tasks:
        hint = did_you_mean(task, tasks)
        faults.append(f"task: unknown task '{task}'{hint}; name your own task like cart.py:TASK")
    for row in rows if isinstance(rows, list) else ():
        if isinstance(row, str) and base_method(row) not in (*METHOD_NAMES, *added):
            hint = did_you_mean(base_method(row), (*METHOD_NAMES, *added))
            faults.append(f"methods: unknown method '{row}'{hint}")
    faults += [f"{key}: unknown key{did_you_mean(key, known)}" for key in tables if key not in known]
    for name, table in tables.items():
        if name in TABLES and isinstance(table, dict):
            keys = {field.target.id for place in TABLES[name] for field, _ in fields_of(place)}
            unknown = [key for key in table if key not in keys]
            faults += [f"{name}.{key}: unknown key{did_you_mean(key, sorted(keys))}" for key in unknown]
    if faults:
        raise RecipeError(f"{path}: {'; '.join(faults)}")


@cache
def fields_of(place: str) -> list[tuple[Any, str]]:
    """Return the fields of a model at "package.module:Model", its bases' too, each with the text below it."""
    module, _, name = place.partition(":")
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    (model,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    imported = {
        alias.name: f"{node.module}:{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    found: list[tuple[Any, str]] = []
    for base in model.bases:
        if isinstance(base, ast.Name) and base.id not in ("Config", "BaseModel"):
            found += fields_of(imported.get(base.id, f"{module}:{base.id}"))
    return [*found, *_fields(model)]


def _fields(model: ast.ClassDef) -> Iterator[tuple[Any, str]]:
    for node, after in zip(model.body, [*model.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            match after:
                case ast.Expr(value=ast.Constant(value=str() as text)):
                    yield node, " ".join(text.split())
                case _:
                    yield node, ""


def check_asked(
    recipe: Path,
    methods: Collection[str] | None = None,
    seeds: Collection[int] | None = None,
    percents: Collection[int] | None = None,
) -> None:
    """Refuse rows, seeds and sizes that a recipe's file does not list; where it is unclear, refuse nothing.

    Raises:
        BadInputError: the recipe has no such row, seed or size.
        RecipeError: its file, or that of its base, cannot be read.
    """
    from astra_data.core.config import load_tables

    if recipe.is_dir() or not (methods or seeds or percents):
        return
    tables = load_tables(recipe)
    base = recipe.with_name(f"{tables.get('based_on')}.toml")
    tables = (load_tables(base) if base.is_file() else {}) | tables
    sweep = tables.get("sweep")
    sizes = sweep.get("percent", []) if isinstance(sweep, dict) else []
    match (tables.get("methods"), tables.get("seeds"), sizes):
        case (list() as rows, list() as known, list() as sizes):
            refuse_unknown(methods or (), seeds or (), percents or (), rows, known, sizes)


def refuse_unknown(
    methods: Collection[str],
    seeds: Collection[int],
    percents: Collection[int],
    known_methods: Collection[str],
    known_seeds: Collection[int],
    known_percents: Collection[int],
) -> None:
    """Refuse rows, seeds and sizes that are not among those of a recipe.

    Raises:
        BadInputError: the recipe has no such method, seed or size.
    """
    from astra_data.core.config import did_you_mean

    for method in methods:
        if method not in known_methods:
            raise BadInputError(f"the recipe has no method '{method}'{did_you_mean(method, known_methods)}")
    for what, asked, known in (("seed", seeds, known_seeds), ("size", percents, known_percents)):
        unknown = next((value for value in asked if value not in known), None)
        if unknown is not None:
            listed = ", ".join(map(str, known)) or "none"
            raise BadInputError(f"the recipe has no {what} {unknown}; its {what}s: {listed}")


def refuse_unmade(settings: Mapping[str, Any], row: str, seed: int) -> None:
    """Refuse a row or a seed that a run's recipe, which had these `settings`, does not have.

    Raises:
        BadInputError: it has no such row or seed.
    """
    from astra_data.core.config import did_you_mean

    rows, seeds = settings.get("methods", [row]), settings.get("seeds", [seed])
    if row not in rows:
        raise BadInputError(f"the run has no row '{row}'{did_you_mean(row, rows)}")
    if seed not in seeds:
        raise BadInputError(f"the run has no seed {seed}; its seeds: {', '.join(map(str, seeds))}")
