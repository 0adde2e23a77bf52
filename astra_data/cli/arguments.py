"""Arguments of several commands, options from the models of settings, and what several commands do."""

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from importlib.util import find_spec
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS, STAGE_NAMES

if TYPE_CHECKING:
    from rich.table import Table


_PLACES = "a folder, name@data-1.2.0, or a name (for its highest version)"
_ITS_OWN = "The settings below are not for a recipe, which has its own."
DatasetName = Annotated[str, typer.Argument(metavar="DATASET", help=f"A dataset: {_PLACES}.")]
Source = Annotated[
    str, typer.Argument(metavar="RECIPE|DATASET", help=f"A recipe (.toml), or dataset: {_PLACES}. {_ITS_OWN}")
]
TaskOrRecipe = Annotated[
    str, typer.Argument(metavar="RECIPE|TASK", help=f"A recipe (.toml), or a task such as antmaze-umaze. {_ITS_OWN}")
]
StoredSeeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="Random seed; of a recipe, run only this one.", show_default="stored; all of a recipe"),
]
Out = Annotated[Path | None, typer.Option(help="The new folder.", show_default="in $ASTRA_DATA_HOME or ./datasets")]
NewName = Annotated[
    str | None, typer.Option(help="Name of the new dataset, whose next version it is.", show_default="a new version")
]
RecipePath = Annotated[Path, typer.Argument(metavar="RECIPE", help="A recipe (TOML file).")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run, such as runs/cart.")]
Methods = Annotated[list[str] | None, typer.Option("--method", metavar="ROW", help="Only this row; may be repeated.")]
Seeds = Annotated[list[int] | None, typer.Option("--seed", help="Run only this seed of the recipe; may be repeated.")]
Device = Annotated[str, typer.Option(help="PyTorch device for the networks: cpu, cuda, cuda:1, …")]
Jobs = Annotated[int | None, typer.Option(min=1, help="Parallel processes.", show_default="one per core; 2 with cuda")]
Root = Annotated[Path, typer.Option(help="Folder that contains the runs.")]
Until = Annotated[
    str | None,
    typer.Option(
        metavar="STAGE",
        help=f"Stop after this stage: {', '.join(STAGE_NAMES)}.",
        show_default="all",
        autocompletion=lambda: [*STAGE_NAMES],
    ),
]

_KINDS: dict[str, Any] = {
    **dict.fromkeys(("int", "Count", "AtOnce", "CountFromZero"), int),
    **dict.fromkeys(("float", "Positive", "NotNegative", "Share"), float),
    "bool": bool,
}  # types of settings by name, and what stands for one on the command line; else the default decides


def with_settings(place: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a command take as `settings` an option for each field of the model at "module:Model", which is not loaded."""

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        options = [_option(field, about) for field, about in fields_of(place)]

        @wraps(command)
        def run(**given: Any) -> None:
            typed = {one.name: value for one in options if (value := given.pop(one.name)) is not None}
            command(settings=typed, **given)

        given = signature(command).parameters.values()
        parameters = [one for other in given for one in (options if other.name == "settings" else [other])]
        run.__dict__.pop("__wrapped__")
        run.__dict__["__signature__"] = Signature(parameters)
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorated


def fields_of(place: str) -> list[tuple[Any, str]]:
    """Return the fields of a model at "package.module:Model", each with the text below it."""
    module, _, name = place.partition(":")
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    (model,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    found: list[tuple[Any, str]] = []
    for node, after in zip(model.body, [*model.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found.append((node, " ".join(str(text).split())))
    return found


def _option(field: ast.AnnAssign, about: str) -> Parameter:
    """Return the parameter of a command for a field, which is None where it is not typed."""
    assert isinstance(field.target, ast.Name)
    name, value = field.target.id, field.value
    if isinstance(value, ast.Call):
        value = next(keyword.value for keyword in value.keywords if keyword.arg == "default")
    assert value is not None
    default = ast.literal_eval(value)
    types = (node.id for node in ast.walk(field.annotation) if isinstance(node, ast.Name))
    kind: Any = next((_KINDS[one] for one in types if one in _KINDS), str)
    shown: Any = False if default is None else str(default)
    flag, flags, metavar = name.replace("_", "-"), list[str](), None
    if isinstance(default, bool):
        flags, shown = [f"--{flag}/--no-{flag}"], flag if default else f"no-{flag}"
    if isinstance(default, tuple):
        kind, metavar, shown = tuple[float, float], "LEAST LARGEST", " ".join(f"{end:g}" for end in default)
    option = typer.Option(*flags, help=about.replace("`", ""), show_default=shown, metavar=metavar)
    annotation: Any = Annotated[kind | None, option]
    return Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)


def show_table(table: "Table") -> None:
    """Print `table`, with its cells as they are: brackets and colons are no markup."""
    from rich.console import Console

    Console(markup=False, emoji=False).print(table)


@contextmanager
def resumable(how: str = "run the same command again to continue") -> Iterator[None]:
    """At Ctrl-C, print how to continue, and exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"stopped: {how}", err=True)
        raise typer.Exit(130) from None


def run_stage(recipe: Path, stage: str, **options: Any) -> Path:
    """Run one stage of a recipe, without options that are None, and print the folder of its artifacts."""
    options = {name: value for name, value in options.items() if value is not None}
    from astra_data.pipeline.run import run_stage as run

    folder = run(recipe, stage, **options)
    if stage != "report":
        typer.echo(f"finished: {folder}")
    return folder


def of_recipe(
    place: str,
    stage: str,
    own: Mapping[str, object],
    *,
    seeds: Sequence[int] | None,
    jobs: int | None,
    root: Path = RUNS,
    table: str = "",
) -> bool:
    """Run a stage of the recipe at `place`, if it is one, which sets the stage's `own` options itself."""
    if place.endswith(".toml"):
        if given := [f"--{name.replace('_', '-')}" for name, value in own.items() if value is not None]:
            raise BadInputError(f"{stage}: the recipe's [{table or stage}] sets this: leave out {', '.join(given)}")
        run_stage(Path(place), stage, seeds=seeds, jobs=jobs, root=root)
    elif len(seeds or ()) > 1 or jobs is not None or root != RUNS:
        raise BadInputError(f"{stage}: give at most one --seed, no --jobs and no --root (these are for recipes)")
    return place.endswith(".toml")
