"""Arguments of several commands, and their checks before a command imports anything slow."""

import re
from pathlib import Path
from typing import Annotated

import typer

from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import RECORD, RUNS, STAGE_NAMES


def recipe_at(path: Path) -> Path:
    """Refuse a path at which there is no recipe, and say where one of this name is.

    Raises:
        RecipeError: there is no such file, or it is not TOML.
    """
    from astra_data.core.config import load_tables
    from astra_data.pipeline.shipped import whereabouts

    if path.is_dir():  # a run or a dataset, perhaps: what is read then says so
        return path
    try:
        load_tables(path)
    except RecipeError as error:
        place = "" if path.exists() else whereabouts(path.name.removesuffix(".toml"))
        raise RecipeError(f"{path} does not exist: {place}" if place else str(error)) from None
    return path


def run_at(folder: Path) -> Path:
    """Refuse what is no folder of a run.

    Raises:
        BadInputError: it has no record of a recipe.
    """
    from astra_data.core.config import did_you_mean

    if not (folder / RECORD).is_file():
        known = [str(record.parent) for record in sorted(RUNS.glob(f"*/{RECORD}"))]
        raise BadInputError(
            f"{folder}: expected the folder of a run (with {RECORD}): make it with astra-data run"
            f"{did_you_mean(str(folder), known)}"
        )
    return folder


def task_at(name: str) -> str:
    """Refuse a task in a file that does not exist; names, and recipes, are looked up later.

    Raises:
        BadInputError: there is no such file.
    """
    file = Path(name.rpartition(":")[0])
    if file.suffix == ".py" and not file.is_file():
        raise BadInputError(f"{name}: expected a file {file}, found none: write path.py:TASK")
    return name


def _stage(name: str | None) -> str | None:
    from astra_data.core.config import did_you_mean

    if name is not None and name not in STAGE_NAMES:
        raise BadInputError(f"unknown stage '{name}'{did_you_mean(name, STAGE_NAMES)}")
    return name


def _device(name: str) -> str:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise BadInputError(f"expected a device such as cpu, cuda or cuda:1, got '{name}'")
    return name


DatasetName = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="A folder, name@data-1.2.0, or a name (for its highest version).",
        show_default=False,
    ),
]
Source = Annotated[
    str,
    typer.Argument(
        metavar="RECIPE|DATASET",
        help="A recipe (.toml), or a dataset: a folder, name@data-1.2.0, or a name (for its highest "
        "version). The settings below apply to a dataset only; a recipe has its own.",
        show_default=False,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the new dataset.", show_default="its place in $ASTRA_DATA_HOME or ./datasets"
    ),
]

NewName = Annotated[
    str | None,
    typer.Option(
        "--name",
        help="Name of the new dataset, which starts at version 1.0.0; where there are datasets of that name, "
        "it is their next version.",
        show_default="a new version",
    ),
]
RecipePath = Annotated[
    Path,
    typer.Argument(metavar="RECIPE", help="A recipe (TOML file).", show_default=False),
]
RecipePaths = Annotated[list[Path], typer.Argument(metavar="RECIPE...", help="Recipes (TOML files).")]
RunFolder = Annotated[
    Path,
    typer.Argument(metavar="RUN", help="The folder of a run, such as runs/cart.", show_default=False),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="ROW",
        help="Run only this row of the recipe; may be repeated.",
        show_default=False,
    ),
]
Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="Run only this seed of the recipe; may be repeated.", show_default=False),
]
Device = Annotated[
    str, typer.Option(help="PyTorch device for the networks: cpu, cuda, cuda:1, …", callback=_device)
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of parallel processes; on a CUDA device, each has its own CUDA context.",
        show_default="one per core; 2 with --device cuda",
    ),
]
Root = Annotated[Path, typer.Option(help="Folder that contains the runs.")]
Until = Annotated[
    str | None,
    typer.Option(
        metavar="STAGE",
        help=f"Stop after this stage: {', '.join(STAGE_NAMES)}.",
        show_default="all",
        callback=_stage,
        autocompletion=lambda: [*STAGE_NAMES],
    ),
]


def check_asked(
    recipe: Path,
    methods: list[str] | None = None,
    seeds: list[int] | None = None,
    percents: list[int] | None = None,
) -> None:
    """Refuse rows, seeds and sizes that a recipe's file does not list; where it is unclear, refuse nothing.

    Raises:
        BadInputError: the recipe has no such row, seed or size.
        RecipeError: its file, or that of its base, cannot be read.
    """
    from astra_data.core.config import load_tables
    from astra_data.pipeline.points import refuse_unknown

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
