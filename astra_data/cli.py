"""The command line: thin doors to `astra_data.run`.

Only here do imports stand inside functions, so that `astra-data --help` answers at once.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from astra_data.commands.import_ import import_
from astra_data.errors import AstraDataError

app = typer.Typer(
    help="Robot trajectories into datasets, datasets into policies that transfer from an abstract simulator.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

RecipePath = Annotated[
    Path, typer.Argument(metavar="RECIPE", help="A recipe, a TOML file.", show_default=False)
]
RecipePaths = Annotated[list[Path], typer.Argument(metavar="RECIPE...", help="Recipes, TOML files.")]
Method = Annotated[str | None, typer.Option(help="Only this row of the recipe.", show_default=False)]
Seeds = Annotated[
    list[int] | None,
    typer.Option("--seed", help="Only this seed of the recipe; may be repeated.", show_default=False),
]
Device = Annotated[str, typer.Option(help="Torch device of the networks: cpu, cuda, cuda:1, …")]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Items at a time, each in its own process; on a CUDA device, each with its own CUDA context.",
        show_default="one per core; 2 with --device cuda",
    ),
]
Root = Annotated[Path, typer.Option(help="Folder of all runs.")]
Until = Annotated[str | None, typer.Option(help="The last stage to run.", show_default="all")]
Publish = Annotated[
    bool, typer.Option("--publish", help="Also copy the results to results/ beside the recipe.")
]

RUNS = Path("runs")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"astra-data {version('astra-data')}")
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Options before any command."""


@app.command()
def run(
    recipe: RecipePath,
    seeds: Seeds = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    until: Until = None,
    root: Root = RUNS,
) -> None:
    """Run all stages of a recipe; run it again to go on from where it stopped."""
    from astra_data.run import run as run_recipe

    with _resumable():
        folder = run_recipe(recipe, seeds=seeds or (), root=root, jobs=jobs, device=device, until=until)
        typer.echo(f"finished: {folder}")


@app.command()
def check(recipes: RecipePaths, root: Root = RUNS) -> None:
    """Check recipes without running them, and list what is finished and what is to do."""
    from astra_data.run import check as check_recipe

    faults: list[str] = []
    for recipe in recipes:
        try:
            finished = check_recipe(recipe, root=root)
        except AstraDataError as error:
            faults.append(str(error))
            continue
        typer.echo(f"{recipe}: {sum(finished.values())} of {len(finished)} items are finished")
        for key, is_finished in finished.items():
            typer.echo(f"  {'finished' if is_finished else 'to do   '}  {key}")
    if faults:
        raise AstraDataError("\n".join(faults))


@app.command()
def collect(recipe: RecipePath, seeds: Seeds = None, jobs: Jobs = None, root: Root = RUNS) -> None:
    """Collect a dataset in the target environment."""
    _run_stage(recipe, "collect", seeds=seeds or (), jobs=jobs, root=root)


@app.command()
def pair(recipe: RecipePath, seeds: Seeds = None, jobs: Jobs = None, root: Root = RUNS) -> None:
    """Add to every transition where the abstract simulator lands from the same state."""
    _run_stage(recipe, "pair", seeds=seeds or (), jobs=jobs, root=root)


@app.command()
def ground(
    recipe: RecipePath,
    method: Method = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    root: Root = RUNS,
) -> None:
    """Learn to correct the abstract simulator from the pairs."""
    _run_stage(recipe, "ground", method=method, seeds=seeds or (), jobs=jobs, device=device, root=root)


@app.command()
def train(
    recipe: RecipePath,
    method: Method = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    root: Root = RUNS,
) -> None:
    """Train policies in the abstract simulator, grounded where the method grounds it."""
    _run_stage(recipe, "train", method=method, seeds=seeds or (), jobs=jobs, device=device, root=root)


@app.command()
def align(
    recipe: RecipePath,
    method: Method = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    root: Root = RUNS,
) -> None:
    """Learn the encoder of target histories that agrees with the simulator's."""
    _run_stage(recipe, "align", method=method, seeds=seeds or (), jobs=jobs, device=device, root=root)


@app.command()
def evaluate(
    recipe: RecipePath,
    method: Method = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    root: Root = RUNS,
) -> None:
    """Run the policies in the target environment."""
    _run_stage(recipe, "evaluate", method=method, seeds=seeds or (), jobs=jobs, root=root)


@app.command()
def report(recipe: RecipePath, seeds: Seeds = None, publish: Publish = False, root: Root = RUNS) -> None:
    """Write the recipe's tables and figures."""
    _run_stage(recipe, "report", seeds=seeds or (), publish=publish, root=root)


app.command("import")(import_)


def _run_stage(
    recipe: Path,
    stage: str,
    *,
    root: Path,
    method: str | None = None,
    seeds: Sequence[int] = (),
    jobs: int | None = None,
    device: str = "cpu",
    publish: bool = False,
) -> None:
    from astra_data.run import run_stage

    with _resumable():
        folder = run_stage(
            recipe, stage, method=method, seeds=seeds, root=root, jobs=jobs, device=device, publish=publish
        )
        typer.echo(f"finished: {folder}")


@contextmanager
def _resumable() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("stopped: run the same command again to go on from here", err=True)
        raise typer.Exit(130) from None


def main() -> None:
    """Run the command line; a reported error becomes one line, unless ASTRA_DATA_DEBUG is set."""
    try:
        app()
    except AstraDataError as error:
        if os.environ.get("ASTRA_DATA_DEBUG"):
            raise
        typer.echo(f"error: {error}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
