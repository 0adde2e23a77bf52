"""Arguments of several commands, options from the models of settings, and tables in the terminal."""

import ast
import re
from collections.abc import Callable, Iterator
from functools import wraps
from importlib.util import find_spec
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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


_KINDS: dict[str, Any] = {
    **dict.fromkeys(("int", "Count", "AtOnce", "CountFromZero"), int),
    **dict.fromkeys(("float", "Positive", "NotNegative", "Share"), float),
    "bool": bool,
}
"""Types of settings by name, and what stands for one on the command line; else the default decides."""


class Setting(NamedTuple):
    """A field of a model: its name, its type on the command line, its default, and the text below it."""

    name: str
    kind: Any
    default: Any
    about: str


def settings_of(place: str) -> list[Setting]:
    """Return the fields of a model at "package.module:Model", as its source says.

    The module is not run: it may take seconds to load.
    """
    module, _, name = place.partition(":")
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    (model,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    return list(_settings(model))


def with_settings(place: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a command take an option for each field of a model, in the place of its parameter `settings`.

    That is then given those that were typed, by their names.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        fields = {setting.name: setting for setting in settings_of(place)}

        @wraps(command)
        def run(**given: Any) -> None:  # noqa: ANN401 - of any option
            typed = {name: value for name in fields if (value := given.pop(name)) is not None}
            command(settings=typed, **given)

        parameters: list[Parameter] = []
        for parameter in signature(command).parameters.values():
            is_theirs = parameter.name == "settings"
            parameters += map(_option, fields.values()) if is_theirs else [parameter]
        run.__dict__.pop("__wrapped__")
        run.__dict__["__signature__"] = Signature(parameters)
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorated


def _settings(model: ast.ClassDef) -> Iterator[Setting]:
    texts: list[Any] = [*model.body[1:], None]
    for node, after in zip(model.body, texts, strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        value = node.value
        if isinstance(value, ast.Call):
            value = next(keyword.value for keyword in value.keywords if keyword.arg == "default")
        assert value is not None
        default = ast.literal_eval(value)
        match after:
            case ast.Expr(value=ast.Constant(value=str() as text)):
                about = " ".join(text.split())
            case _:
                about = ""
        yield Setting(node.target.id, _kind(node.annotation, default), default, about)


def _kind(annotation: ast.expr, default: object) -> Any:  # noqa: ANN401 - a type
    """Return the type of an option for values of an annotation such as `Count | None`."""
    names = (node.id for node in ast.walk(annotation) if isinstance(node, ast.Name))
    kind = next((_KINDS[name] for name in names if name in _KINDS), str)
    return tuple[float, float] if isinstance(default, tuple) else kind


def _option(setting: Setting) -> Parameter:
    dashed, default = setting.name.replace("_", "-"), setting.default
    shown: Any = False if default is None else str(default)
    names: list[str] = []
    if isinstance(default, bool):
        names = [f"--{dashed}/--no-{dashed}"]
        shown = dashed if default else f"no-{dashed}"
    metavar = "LEAST LARGEST" if isinstance(default, tuple) else None
    if isinstance(default, tuple):
        shown = " ".join(f"{end:g}" for end in default)
    about = setting.about.replace("`", "")
    option = typer.Option(*names, help=about, show_default=shown, metavar=metavar)
    annotation: Any = Annotated[setting.kind | None, option]
    return Parameter(setting.name, Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)


if TYPE_CHECKING:
    from rich.table import Table


def show_table(table: "Table") -> None:
    """Print `table`, with its cells as they are: brackets and colons are no markup."""
    from rich.console import Console

    Console(markup=False, emoji=False).print(table)
