"""Commands that work on recipes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import (
    Device,
    Jobs,
    Methods,
    RecipePath,
    RecipePaths,
    Root,
    Seeds,
    Until,
    check_asked,
    recipe_at,
)
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.naming import RUNS

Publish = Annotated[
    bool,
    typer.Option("--publish", help="Add the results to those in the folder results/ next to the recipe."),
]


def run(
    recipe: RecipePath,
    seeds: Seeds = None,
    jobs: Jobs = None,
    device: Device = "cpu",
    until: Until = None,
    root: Root = RUNS,
) -> None:
    """Run all stages of a recipe; after an interruption, run it again to continue."""
    check_asked(recipe_at(recipe), seeds=seeds)
    from astra_data.pipeline.run import run as run_recipe

    with resumable():
        folder = run_recipe(recipe, seeds=seeds or (), root=root, jobs=jobs, device=device, until=until)
        show_made(folder, until)


def check(
    recipes: RecipePaths,
    root: Root = RUNS,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Read every byte of the artifacts instead of comparing only their sizes."
        ),
    ] = False,
) -> None:
    """Check recipes without running them, and list which artifacts are finished, damaged or stale."""
    for recipe in recipes:
        recipe_at(recipe)
    from astra_data.pipeline.run import check as check_recipe

    faults: list[str] = []
    for recipe in recipes:
        try:
            conditions = check_recipe(recipe, root=root, verify=verify)
        except AstraDataError as error:
            faults.append(str(error))
            continue
        states = [found.state for found in conditions.values()]
        typer.echo(f"{recipe}: {states.count('finished')} of {len(states)} items are finished")
        for key, found in conditions.items():
            why = f": {found.why}" if found.why else ""
            typer.echo(f"  {'to do' if found.state == 'missing' else found.state:8}  {key}{why}")
            for warning in found.warnings:
                typer.echo(f"  warning   {key}: {warning}")
        spoilt = [f"{states.count(state)} {state}" for state in ("damaged", "stale") if state in states]
        if spoilt:
            again = f"`astra-data run {recipe}` recreates these"
            # What differs in its bytes alone, `run` finds only once a step reads it.
            again = (
                f"move them away, and {again}"
                if verify
                else f"{again}, except those that the list asks you to remove"
            )
            faults.append(f"{recipe}: {' and '.join(spoilt)}: {again}")
    if faults:
        raise AstraDataError("\n".join(faults))


def _of_networks(stage: str, summary: str) -> Callable[..., None]:
    """Return the command of a stage that fits networks."""

    def command(
        recipe: RecipePath,
        methods: Methods = None,
        seeds: Seeds = None,
        jobs: Jobs = None,
        device: Device = "cpu",
        root: Root = RUNS,
    ) -> None:
        run_stage(
            recipe, stage, methods=methods or (), seeds=seeds or (), jobs=jobs, device=device, root=root
        )

    command.__doc__ = summary
    return command


ground = _of_networks("ground", "Fit each method's correction of the abstract simulator to the pairs.")
train = _of_networks(
    "train", "Train policies where each method trains them, for most in the (corrected) abstract simulator."
)
align = _of_networks("align", "Fit the target encoder so that its latents match those of the grounding.")


def evaluate(
    recipe: RecipePath,
    methods: Methods = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    root: Root = RUNS,
    policy: Annotated[
        str | None,
        typer.Option(
            help="Test this policy of yours instead of the row's: path.py:POLICY. Its code is run.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="With --policy: the folder to write.", show_default=False)
    ] = None,
) -> None:
    """Run the policies in the target environment (if the task has one) and in simulators."""
    if policy is None:
        if out is not None:
            raise BadInputError("evaluate: --out goes with --policy; without it, leave out --out")
        run_stage(recipe, "evaluate", methods=methods or (), seeds=seeds or (), jobs=jobs, root=root)
        return
    if not (methods and seeds and out) or len(methods) + len(seeds) > 2 or jobs is not None:
        raise BadInputError(
            "evaluate: with --policy, give one --method, one --seed and --out, and leave out --jobs"
        )
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.grounded_env import evaluate_policy
    from astra_data.worlds.user_code import user_object

    with shown("evaluate") as progress:
        evaluate_policy(
            root / recipe.stem, methods[0], user_object(policy), out=out, seed=seeds[0], progress=progress
        )
    typer.echo(f"finished: {out}")


def report(recipe: RecipePath, seeds: Seeds = None, publish: Publish = False, root: Root = RUNS) -> None:
    """Write the recipe's tables and figures."""
    run_stage(recipe, "report", seeds=seeds or (), publish=publish, root=root)


def run_stage(
    recipe: Path,
    stage: str,
    *,
    root: Path,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    jobs: int | None = None,
    device: str = "cpu",
    publish: bool = False,
) -> None:
    """Run one stage of a recipe, and print the folder of its artifacts."""
    check_asked(recipe_at(recipe), [*methods], [*seeds])
    from astra_data.pipeline.run import run_stage as run

    with resumable():
        folder = run(
            recipe,
            stage,
            methods=methods,
            seeds=seeds,
            root=root,
            jobs=jobs,
            device=device,
            publish=publish,
        )
        if stage == "report":
            show_made(folder.parent, None)
        else:
            typer.echo(f"finished: {folder}")


def show_made(folder: Path, until: str | None, *others: Path) -> None:
    """Print what a run that went on `until` a stage has found, and the paths of its pages and of `others`.

    After the report: the verdict, best method, floor and the interval between them, and the command that
    deploys it. Where it ends with its groundings: the page of their held-out errors.
    """
    from astra_data.pipeline.plan import stages_until
    from astra_data.pipeline.stages.report import HTML, JSON
    from astra_data.reports.held_out import PAGE
    from astra_data.reports.results import read_results
    from astra_data.reports.verdict import verdict_of

    made = stages_until(until)
    if until == "ground" and (folder / PAGE).is_file():
        typer.echo((folder / PAGE).read_text())
    typer.echo(f"finished: {folder}")
    found = folder / "report" / JSON
    verdict = verdict_of(read_results(found)) if "report" in made and found.is_file() else None
    if verdict:
        typer.echo(verdict.text.replace("**", ""))
        for label, text in verdict.lines:
            typer.echo(f"  {label:8}  {text}")
        if verdict.row is None:
            for remark in verdict.remarks:
                typer.echo(f"  {remark}")
    pages = {"ground": folder / PAGE, "report": folder / "report" / HTML}
    for file in (*(page for stage, page in pages.items() if stage in made), *others):
        if file.is_file():
            typer.echo(str(file))
    if verdict and (command := verdict.command(folder)):
        typer.echo(command)


def refuse(options: Mapping[str, object], stage: str, table: str | None = None) -> None:
    """Refuse `options` that are given, since a recipe sets them itself.

    Raises:
        BadInputError: one is given.
    """
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value is not None]
    if given:
        raise BadInputError(
            f"{stage}: the recipe's [{table or stage}] sets this: leave out {', '.join(given)}"
        )


@contextmanager
def resumable(how: str = "run the same command again to continue") -> Iterator[None]:
    """At Ctrl-C, print how to continue, and exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"stopped: {how}", err=True)
        raise typer.Exit(130) from None
