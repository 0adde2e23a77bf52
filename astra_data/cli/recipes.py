"""Commands on recipes and runs, of stages alone, and what to begin with."""

import os
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from astra_data.cli import arguments
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.naming import RUNS, artifact_key, first_few

if TYPE_CHECKING:
    from astra_data.reports.choice import Trials


def run(
    recipe: arguments.RecipePath,
    methods: arguments.Methods = None,
    seeds: arguments.Seeds = None,
    percents: Annotated[list[int] | None, typer.Option("--percent", help="Only this size; may be repeated.")] = None,
    jobs: arguments.Jobs = None,
    device: arguments.Device = "cpu",
    until: arguments.Until = None,
    root: arguments.Root = RUNS,
    engine: Annotated[str, typer.Option(help="processes here, or ray: tasks of a Ray cluster.")] = "processes",
    address: Annotated[
        str | None, typer.Option(help="Of a Ray cluster that shares this folder and installation.", show_default="here")
    ] = None,
) -> None:
    """Run all stages of a recipe; after an interruption, run it again to continue."""
    from astra_data.pipeline.run import run as run_recipe

    which: dict[str, Any] = {"methods": methods or (), "seeds": seeds or (), "percents": percents or (), "until": until}
    how: dict[str, Any] = {"jobs": jobs, "device": device, "engine": engine, "address": address}
    show_made(run_recipe(recipe, **which, root=root, **how), until)


def check(
    recipes: Annotated[
        list[str], typer.Argument(metavar="RECIPE|TASK...", help="Recipes (.toml); or tasks: names, or cart.py:TASK.")
    ],
    root: arguments.Root = RUNS,
    verify: Annotated[bool, typer.Option("--verify", help="Read every byte, instead of comparing sizes.")] = False,
) -> None:
    """Check recipes, listing which artifacts are finished, damaged or stale; or tasks. Nothing is run."""
    faults: list[str] = []
    for name in recipes:
        try:
            if ":" in name or Path(name).suffix == ".py" or not (Path(name).suffix or Path(name).exists()):
                _check_task(name)
            else:
                faults += _check_recipe(Path(name), root, verify)
        except AstraDataError as error:
            faults.append(str(error))
    if faults:
        raise AstraDataError("\n".join(faults))


def _check_recipe(recipe: Path, root: Path, verify: bool) -> list[str]:
    from astra_data.pipeline.run import check as check_recipe

    conditions = check_recipe(recipe, root=root, verify=verify)
    states = [found.state for found in conditions.values()]
    typer.echo(f"{recipe}: {states.count('finished')} of {len(states)} items are finished")
    for key, found in conditions.items():
        why = f": {found.why}" if found.why else ""
        typer.echo(f"  {'to do' if found.state == 'missing' else found.state:8}  {key}{why}")
        for warning in found.warnings:
            typer.echo(f"  warning   {key}: {warning}")
    spoilt = [f"{states.count(state)} {state}" for state in ("damaged", "stale") if state in states]
    if not spoilt:
        return []
    again = f"`astra-data run {recipe}` recreates these"
    # What differs in its bytes alone, `run` finds only once a step reads it.
    how = f"move them away, and {again}" if verify else f"{again}, except those that the list asks you to remove"
    return [f"{recipe}: {' and '.join(spoilt)}: {how}"]


def _check_task(name: str) -> None:
    from astra_data.robots.registry import task_named
    from astra_data.worlds.walk_through import check_task

    task = task_named(name)
    if faults := check_task(task):
        raise BadInputError("\n".join(f"task {name}: {fault}" for fault in faults))
    bounds = ", ".join(f"{axis} {low:g}…{high:g}" for axis, (low, high) in task.limits.items())
    names = task.abstract_state.names or (f"{task.abstract_state.size} values",)
    typer.echo(f"commands: {bounds}\nabstract states: {', '.join(names)}")
    typer.echo(f"{name}: found no errors in its states, simulator, objective and robot")


def _of_networks(stage: str, summary: str) -> Callable[..., None]:

    def command(
        recipe: arguments.RecipePath,
        methods: arguments.Methods = None,
        seeds: arguments.Seeds = None,
        jobs: arguments.Jobs = None,
        device: arguments.Device = "cpu",
        root: arguments.Root = RUNS,
    ) -> None:
        arguments.run_stage(recipe, stage, methods=methods, seeds=seeds, jobs=jobs, device=device, root=root)

    command.__doc__ = summary
    return command


ground = _of_networks("ground", "Fit each method's correction of the abstract simulator to the pairs.")
train = _of_networks("train", "Train policies where each method does, for most in the (corrected) abstract simulator.")
align = _of_networks("align", "Fit the target encoder so that its latents match those of the grounding.")


def evaluate(
    recipe: arguments.RecipePath,
    methods: arguments.Methods = None,
    seeds: arguments.Seeds = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
    policy: Annotated[str | None, typer.Option(help="Test this instead, path.py:POLICY. Its code is run.")] = None,
    out: Annotated[Path | None, typer.Option(help="With --policy: the folder to write.")] = None,
) -> None:
    """Run the policies in the target environment (if the task has one) and in simulators."""
    if policy is None:
        if out is not None:
            raise BadInputError("evaluate: --out goes with --policy; without it, leave out --out")
        arguments.run_stage(recipe, "evaluate", methods=methods, seeds=seeds, jobs=jobs, root=root)
        return
    if not (methods and seeds and out) or len(methods) + len(seeds) > 2 or jobs is not None:
        raise BadInputError("evaluate: with --policy, give one --method, one --seed and --out, and leave out --jobs")
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.grounded_env import evaluate_policy
    from astra_data.worlds.user_code import user_object

    with shown("evaluate") as progress:
        evaluate_policy(root / recipe.stem, methods[0], user_object(policy), out=out, seed=seeds[0], progress=progress)
    typer.echo(f"finished: {out}")


def report(
    recipe: arguments.RecipePath,
    seeds: arguments.Seeds = None,
    publish: Annotated[bool, typer.Option("--publish", help="Add the results to results/ beside the recipe.")] = False,
    root: arguments.Root = RUNS,
) -> None:
    """Write the recipe's tables and figures."""
    show_made(arguments.run_stage(recipe, "report", seeds=seeds, publish=publish, root=root).parent, None)


def show_made(folder: Path, until: str | None) -> None:
    """Print what a run that went on `until` a stage has found: held-out errors, or the verdict; and its pages."""
    from astra_data.pipeline.plan import stages_until
    from astra_data.pipeline.run import POINTS
    from astra_data.pipeline.stages.report import HTML, JSON
    from astra_data.reports.diagnosis import DIAGNOSIS
    from astra_data.reports.held_out import PAGE
    from astra_data.reports.results import read_results
    from astra_data.reports.verdict import verdict_of

    made = stages_until(until)
    pages = {"pair": folder / DIAGNOSIS, "ground": folder / PAGE}
    if until in pages and pages[until].is_file():
        typer.echo(pages[until].read_text())
    typer.echo(f"finished: {folder}")
    found = folder / "report" / JSON
    verdict = verdict_of(read_results(found)) if "report" in made and found.is_file() else None
    if verdict:
        shown = [f"{label:8}  {text}" for label, text in verdict.lines]
        remarks = verdict.remarks if verdict.row is None else []
        typer.echo("\n  ".join([verdict.text.replace("**", ""), *shown, *remarks]))
    pages |= {"report": folder / "report" / HTML, "evaluate": folder / POINTS}
    for file in (page for stage, page in pages.items() if stage in made):
        if file.is_file():
            typer.echo(str(file))
    if verdict and (command := verdict.command(folder)):
        typer.echo(command)


def select(
    run: arguments.RunFolder,
    row: Annotated[
        list[str] | None, typer.Option(metavar="ROW", help="Rank only this row; may be repeated.", show_default="all")
    ] = None,
    judge: Annotated[
        str | None, typer.Option(metavar="ROW", help="Its groundings judge.", show_default="nas, else the first")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Episodes of each policy with each judge.", min=1, show_default="recipe's or 100")
    ] = None,
    trials: Annotated[int | None, typer.Option(help="Choose with so many episodes in the target.", min=1)] = None,
    by_hand: Annotated[bool, typer.Option("--by-hand", help="With --trials: a person gives each result.")] = False,
    field: Annotated[
        int | None, typer.Option(help="With --trials: number of candidates to try.", show_default="as many as possible")
    ] = None,
    percent: Annotated[int | None, typer.Option(help="With --trials, after a sweep: of this dataset size.")] = None,
) -> None:
    """Rank the trained policies of a run without the target, or with a few trials in it."""
    if trials is None and (by_hand or field is not None or percent is not None):
        raise BadInputError("--by-hand, --field and --percent need --trials: add --trials, or leave them out")
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.selecting import choose_by_trials
    from astra_data.pipeline.selecting import select as rank
    from astra_data.reports.choice import FOLDER

    given: dict[str, Any] = {"rows": row or (), "judge": judge, "episodes": episodes}
    tried: dict[str, Any] = {"by_hand": _key if by_hand else None, "field": field, "percent": percent}
    spoken = nullcontext(lambda _, note: typer.echo(note, err=True))  # a display would hide what a person is asked
    with spoken if by_hand else shown("select") as given["progress"]:
        if trials is not None:
            lines = [_chosen(choose_by_trials(run, trials, **tried, **given))]
        else:
            judged, lines = rank(run, **given), []
            for size in judged.percents:
                first, at = judged.ranked(size)[0], f" at {size} %" if size else ""
                reached = f"{first.lower:.2f} in the lower quartile of its judges"
                lines.append(f"chosen{at}: {first.row}, seed {first.seed}: {reached}")
    typer.echo("\n".join([*lines, f"written: {run / FOLDER / 'select.md'}"]))


def _chosen(made: "Trials") -> str:
    if made.chosen is None or made.rate is None:
        return f"{made.spent} trials are made: fill in trials.csv beside the page, and run the same command again"
    from astra_data.reports.statistics import Estimate, interval

    row, seed = made.chosen
    return f"chosen with {made.spent} trials: {row}, seed {seed}: success {interval(Estimate(*made.rate))}"


def _key(what: str) -> str:
    typer.echo(what)
    if not sys.stdin.isatty():
        return "q"
    typer.echo("s: success, f: failure, v: void, q: quit", err=True)
    return typer.getchar().lower()


def deploy(
    run: arguments.RunFolder,
    row: Annotated[str, typer.Option(metavar="ROW", help="A row of the run's recipe, such as astra_plus.")],
    out: Annotated[Path | None, typer.Option(help="The new folder.", show_default="RUN/deploy/ROW/seed_SEED")] = None,
    seed: Annotated[int, typer.Option(help="A seed of the run's recipe.")] = 0,
    percent: Annotated[int | None, typer.Option(help="The dataset size in percent, if the recipe has several.")] = None,
) -> None:
    """Export a trained policy as a folder that runs without this package."""
    from astra_data.deployment.folder import deploy as write

    out = out or run / artifact_key("deploy", row, seed, percent)
    typer.echo(f"finished: {write(run, row, out, seed=seed, percent=percent)}")


def view(
    run: arguments.RunFolder,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Write a recording.")] = None,
    uids: Annotated[list[int] | None, typer.Option("--episode", help="Its uid; may be repeated.")] = None,
    seed: Annotated[int | None, typer.Option(help="One of its recipe's.", show_default="the first")] = None,
) -> None:
    """Show a run's held-out episodes in Rerun, and replays of them in its simulators."""
    from astra_data.pipeline.run_view import view_run

    view_run(run, uids or (), seed=seed, save=save)
    if save:
        typer.echo(f"written: {save}")


@arguments.with_settings("astra_data.pipeline.stages.collect:CollectConfig")
def collect(
    task: arguments.TaskOrRecipe,
    settings: dict[str, Any],
    seeds: Annotated[
        list[int] | None,
        typer.Option("--seed", help="Random seed; of a recipe, run only this one.", show_default="0; all of a recipe"),
    ] = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
    name: Annotated[str | None, typer.Option(help="Its name.", show_default="task, behavior and seed")] = None,
    out: arguments.Out = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the same command after an interruption.")] = False,
) -> None:
    """Record episodes in the target environment."""
    own = {**settings, "name": name, "out": out, "resume": resume or None}
    if arguments.of_recipe(task, "collect", own, seeds=seeds, jobs=jobs, root=root):
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # torch's idle threads would slow down the physics; it is not loaded yet
    with arguments.resumable("run the same command with --resume to continue"):
        _make("collect", task, settings, seed=seeds[0] if seeds else 0, out=out, name=name, resume=resume)


@arguments.with_settings("astra_data.pipeline.stages.pair:PairConfig")
def pair(
    dataset: arguments.Source,
    settings: dict[str, Any],
    seeds: arguments.Seeds = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
    simulator: Annotated[
        str | None, typer.Option(help="A task, an installed simulator, or yours: path.py:MySimulator. Its code is run.")
    ] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Add the abstract simulator's next state, from the same state and action, to every step."""
    if not dataset.endswith(".toml") and (seeds or jobs is not None):
        raise BadInputError("pair: with a dataset, leave out --seed and --jobs (these are for recipes)")
    own = {**settings, "simulator": simulator, "name": name, "out": out}
    if arguments.of_recipe(dataset, "pair", own, seeds=seeds, jobs=jobs, root=root):
        return
    if simulator is None:
        raise BadInputError("pair: expected --simulator: a task or path.py:MySimulator")
    _make("pair", simulator, settings, dataset=dataset, name=name, out=out)


@arguments.with_settings("astra_data.pipeline.stages.augment:AugmentConfig")
def augment(
    dataset: arguments.DatasetName,
    settings: dict[str, Any],
    task: Annotated[
        str | None, typer.Option(help="Task that computes rewards and ends of copies.", show_default="the dataset's")
    ] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Add rotated and shifted copies of episodes in a maze; the dataset must not be paired yet."""
    _make("augment", task, settings, dataset=dataset, seed=seed, name=name, out=out)


def label(
    dataset: arguments.DatasetName,
    task: Annotated[str, typer.Option(help="A task: a name, or a place such as cart.py:TASK. Its code is run.")],
    seed: Annotated[int, typer.Option(help="Random seed of the goals.")] = 0,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Compute the goals, rewards, successes and failures that a log lacks, as a task defines them."""
    from astra_data.dataset.versions import locate

    _make("label", task, None, data=locate(dataset), seed=seed, name=name, out=out)


def _make(stage: str, task: str | None, settings: dict[str, Any] | None, **options: object) -> None:
    """Run one stage on its own, and print the folder that it writes."""
    from importlib import import_module

    from astra_data.core.config import validated
    from astra_data.pipeline.display import shown

    module = import_module(f"astra_data.pipeline.stages.{stage}")
    if settings is not None:
        options["config"] = validated(settings, getattr(module, f"{stage.title()}Config"), stage)
    with shown(stage) as progress:
        folder = getattr(module, stage)(task, progress=progress, **options)
    typer.echo(f"finished: {folder}")


_NAMED = 5  # files that are named in a line


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the robot: a-z, 0-9 and _.")],
    logs: Annotated[list[Path] | None, typer.Option("--from", help="Logs: CSV files, folders, or a dataset.")] = None,
    more: Annotated[list[Path] | None, typer.Argument(metavar="[LOG]...", help="More logs: --from logs/*.csv.")] = None,
    out: Annotated[Path | None, typer.Option(help="The new folder.", show_default="NAME")] = None,
) -> None:
    """Start a project for your own robot: a task, a recipe, a mapping of its logs, a test and a page."""
    from rich.table import Table

    from astra_data.pipeline.first_simulator import CLEARLY, JUDGED_STEPS
    from astra_data.pipeline.new_robot import write_robot

    places = [*(logs or ()), *(more or ())]
    if not places:
        advice = "without any, begin with the files of `astra-data recipes copy cart`"
        raise BadInputError(
            f"expected the robot's logs, --from LOGS: CSV files, folders of them or a dataset; {advice}"
        )
    folder = out or Path(name)
    simulator = write_robot(name, folder, places)
    found = simulator.logs
    table = Table("field", "used as", "unit", "factor", "why")
    for field in found.fields:
        table.add_row(field.name, field.taken_for, field.unit, f"{field.scale:.4g}", field.why)
    arguments.show_table(table)
    typer.echo(f"abstract simulator: {simulator.described}")
    simulated, still = simulator.errors()
    if worse := [one for one, is_worse in zip(simulator.names, simulated > CLEARLY * still, strict=True) if is_worse]:
        typer.echo(
            f"after {JUDGED_STEPS} steps it predicts {' and '.join(worse)} of the logs worse than standing "
            f"still would: edit `step` in {folder}/{name}.py"
        )
    for line in (found.uneven, found.still):
        if line:
            typer.echo(f"{line} (CHECK)")
    for field_name, count in found.left_out.items():
        typer.echo(f"{field_name} is not a number in {count} rows, which are left out: see logs.toml (CHECK)")
    if found.cut_off:
        files = first_few(found.cut_off, _NAMED)
        typer.echo(f"{files}: the last line is cut off and is left out, as it is by an import")
    typer.echo(f"finished: {folder}; see {folder}/README.md for the next steps; CHECK marks guesses")


shipped = typer.Typer(no_args_is_help=True)


@shipped.command("list")
def list_() -> None:
    """List the package's recipes, those to begin with first, and its mappings for `import`."""
    from rich.table import Table
    from rich.text import Text

    from astra_data.pipeline.shipped import START_HERE, shipped_recipes

    found = sorted(shipped_recipes(), key=lambda one: one.name not in START_HERE)
    for title, is_mapping in (("Recipes", False), ("Mappings, for astra-data import LOGS --mapping", True)):
        table = Table("name", "what it is", title=title, title_justify="left", box=None)
        table.columns[0].no_wrap = True
        for recipe in (one for one in found if one.is_mapping == is_mapping):
            table.add_row(recipe.name, Text(recipe.about, no_wrap=True, overflow="ellipsis"))
        arguments.show_table(table)
        typer.echo()
    typer.echo(f"To begin: astra-data recipes copy {START_HERE[0]}")


@shipped.command()
def copy(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A name shown by `recipes list`.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to copy to.")] = Path("recipes"),
) -> None:
    """Copy a recipe or mapping, with the recipe it is based on and the code it needs."""
    from astra_data.pipeline import shipped as recipes

    new = recipes.copy_recipe(name, folder)
    path = recipes.shipped(name).path
    place = folder / path
    how = f"import LOGS --mapping {place}" if path.parts[0] == recipes.IMPORTS else f"run {place}"
    typer.echo(f"finished: {len(new)} files; astra-data {how}")
