"""Commands that edit datasets, show them, check them and compare them."""

from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import typer

from astra_data.cli import arguments
from astra_data.core.durable import write_file
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError
from astra_data.core.naming import RUNS, first_few, printable


def subset(
    dataset: arguments.Source,
    episodes: Annotated[int | None, typer.Option(min=1, help="Number of episodes to keep.")] = None,
    percent: Annotated[int | None, typer.Option(min=1, help="The same in percent of --of; may exceed 100.")] = None,
    of: Annotated[int | None, typer.Option(min=1, help="Episodes that are 100 percent.", show_default="all")] = None,
    seeds: arguments.StoredSeeds = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
) -> None:
    """Write a random subset; with the same seed, smaller subsets are contained in larger ones."""
    own = {"episodes": episodes, "percent": percent, "of": of, "name": name, "out": out}
    if arguments.of_recipe(dataset, "subset", own, table="sweep", seeds=seeds, jobs=jobs, root=root):
        return
    from astra_data.dataset.edit import subset as write
    from astra_data.dataset.versions import open_dataset

    seed, source = seeds[0] if seeds else None, open_dataset(dataset)
    _report(write(source, episodes=episodes, percent=percent, of=of, seed=seed, name=name, out=out))


def merge(
    datasets: Annotated[list[str], typer.Argument(metavar="DATASET", help="Of the same columns, fps and simulator.")],
    new_uids: Annotated[bool, typer.Option("--new-uids", help="Give new uids to episodes whose uid is taken.")] = False,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Merge the episodes of several datasets into one."""
    from astra_data.dataset.edit import merge as write
    from astra_data.dataset.versions import open_dataset

    _report(write([open_dataset(dataset) for dataset in datasets], new_uids=new_uids, name=name, out=out))


def filter_(
    dataset: arguments.DatasetName,
    without: Annotated[
        list[int] | None, typer.Option(metavar="UID", help="Leave out the episode with this uid; may be repeated.")
    ] = None,
    success: Annotated[bool | None, typer.Option("--success/--no-success", help="Keep successes, or failures.")] = None,
    min_return: Annotated[float | None, typer.Option(help="Minimum return.")] = None,
    max_return: Annotated[float | None, typer.Option(help="Maximum return.")] = None,
    min_length: Annotated[int | None, typer.Option(help="Minimum steps.")] = None,
    max_length: Annotated[int | None, typer.Option(help="Maximum steps.")] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Write a dataset of the episodes that meet every given condition, without some of them."""
    from astra_data.dataset.edit import filter_episodes
    from astra_data.dataset.versions import open_dataset

    conditions: dict[str, Any] = {"success": success, "min_return": min_return, "max_return": max_return}
    conditions |= {"min_length": min_length, "max_length": max_length, "without": without or ()}
    _report(filter_episodes(open_dataset(dataset), **conditions, name=name, out=out))


def trim(
    dataset: arguments.DatasetName,
    start: Annotated[float, typer.Option(min=0.0, metavar="SECONDS", help="Time to remove from the start.")] = 0.0,
    end: Annotated[float, typer.Option(min=0.0, metavar="SECONDS", help="Time to remove from the end.")] = 0.0,
    still: Annotated[
        bool, typer.Option("--still", help="Remove the steps at either end in which the state does not change.")
    ] = False,
    without: Annotated[str | None, typer.Option(metavar="CONDITION", help="Remove steps such as 'v < 0.05'.")] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Write a dataset with shorter episodes, or without some of their steps."""
    from astra_data.dataset.edit import trim as write
    from astra_data.dataset.versions import open_dataset

    _report(write(open_dataset(dataset), start_s=start, end_s=end, still=still, without=without, name=name, out=out))


def resample(
    dataset: arguments.DatasetName,
    fps: Annotated[int, typer.Option(min=1, help="Steps per second of the new dataset.")],
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Write a dataset at another rate: commands held, states interpolated, times true."""
    from astra_data.dataset.edit import resample as write
    from astra_data.dataset.versions import open_dataset

    _report(write(open_dataset(dataset), fps, name=name, out=out))


def features(
    dataset: arguments.DatasetName,
    camera: Annotated[str, typer.Option(help="A camera, such as front for observation.images.front.")],
    encoder: Annotated[
        str | None, typer.Option(metavar="FILE.py:NAME", help="Your own: its code runs.", show_default="the package's")
    ] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Write a dataset with a column of what a frozen encoder makes of a camera's pictures."""
    from astra_data.dataset.versions import open_dataset
    from astra_data.grounding.features import DEFAULT
    from astra_data.grounding.features import features as write
    from astra_data.pipeline.display import shown

    source = open_dataset(dataset)
    with shown("features") as progress:
        folder = write(source, camera, encoder or DEFAULT, name=name, out=out, progress=progress)
    _report(folder)


def _report(folder: Path) -> None:
    from astra_data.dataset.reader import Dataset
    from astra_data.dataset.versions import home_of, versions_at_home

    written = Dataset.open(folder)
    typer.echo(f"finished: {folder} ({written.reference}, {len(written)} episodes, {written.lengths.sum()} steps)")
    name, version = written.description["name"], written.description["version"]
    versions = [str(known) for known in versions_at_home(name)]
    if folder == home_of(written.description) and versions[-1] == version and len(versions) > 1:
        typer.echo(f"note: {name} now means this version, no longer data-{versions[-2]}; --name keeps both apart")


def inspect(
    dataset: arguments.DatasetName,
    plot: Annotated[Path | None, typer.Option(help="Folder for figures of positions and velocities.")] = None,
) -> None:
    """Show a dataset's values, episodes, a map of visited positions, and what looks wrong."""
    from rich.console import Console

    from astra_data.cli.inspection_page import inspection_page
    from astra_data.dataset.checkup import check_up
    from astra_data.dataset.inspection import inspect_dataset
    from astra_data.dataset.versions import open_dataset

    found = open_dataset(dataset)
    inspection, checkup = inspect_dataset(found), check_up(found, quote(dataset))
    Console(soft_wrap=True).print(inspection_page(inspection, checkup))
    if plot is None:
        return
    from astra_data.reports.figures.style import coverage, png

    maps = {("position", "m"): inspection.positions, ("velocity", "m/s"): inspection.velocities}
    if not any(maps.values()):
        advice = "give its columns a role in the mapping, or leave out --plot"
        raise BadInputError(f"{found.reference}: expected a state with the role position or vector, got none: {advice}")
    for (label, unit), planar in maps.items():
        if planar:
            path = plot / f"{label}_coverage.png"
            write_file(path, png(coverage(planar.counts, planar.extent, label, unit)))
            typer.echo(f"written: {path}")


def list_(tasks: Annotated[bool, typer.Option("--tasks", help="Instead, list the named tasks.")] = False) -> None:
    """List the datasets in the home folder, and their versions; or the named tasks."""
    if tasks:
        _list_tasks()
        return
    from rich.table import Table

    from astra_data.dataset.description import full_name
    from astra_data.dataset.versions import home, names_at_home, open_dataset, versions_at_home

    faults: list[str] = []
    table = Table("dataset", "stage", "episodes", "steps", "content", title=printable(str(home())))
    for name in names_at_home():
        for version in versions_at_home(name):
            reference = full_name({"name": name, "version": version})
            try:
                found = open_dataset(reference)
            except AstraDataError as error:
                table.add_row(reference, "damaged", "", "", "")
                faults.append(str(error))
                continue
            steps = int(found.lengths.sum())
            facts = (printable(found.description["stage"]), f"{len(found):,}", f"{steps:,}", found.content_hash[:12])
            table.add_row(found.reference, *facts)
    arguments.show_table(table)
    if faults:
        raise CorruptDatasetError("\n".join(faults))


def _list_tasks() -> None:
    from rich.table import Table

    from astra_data.robots.registry import TASKS, known_names, task_named

    table = Table("task", "commands", "abstract states", "target", "steps/s")
    table.columns[0].no_wrap = True
    for name in known_names():
        known = task_named(name)
        states = known.abstract_state.names or (f"{known.abstract_state.size} values",)
        shown = name if name in TASKS else f"{name} (installed)"
        values = first_few(list(known.limits), 4), first_few(states, 4)
        table.add_row(shown, *values, "yes" if known.has_target else "no", str(known.fps))
    arguments.show_table(table)
    own = "Name your own task by its place: cart.py:TASK or package.module:TASK. Its code is run."
    typer.echo(f"`astra-data check TASK` tests one and shows all its values. {own}")


def validate(
    dataset: arguments.DatasetName,
    with_lerobot: Annotated[bool, typer.Option("--with-lerobot", help="Compare with lerobot's loader (slow).")] = False,
) -> None:
    """Check every file and value of a LeRobot dataset and list all errors."""
    from astra_data.dataset.columns import TERMINATED
    from astra_data.dataset.doctor.check import check, compare_with_lerobot
    from astra_data.dataset.inspection import endings_of
    from astra_data.dataset.reader import Dataset
    from astra_data.dataset.versions import locate

    root = locate(dataset)
    report = check(root)
    if with_lerobot and not report.faults:
        compare_with_lerobot(root, report)
    for note in report.notes:
        typer.echo(f"note: {printable(note)}")
    if report.faults:
        count = "1 error" if report.fault_count == 1 else f"{report.fault_count} errors"
        message = "\n  ".join([f"{root} has {count}:", *report.faults])
        advice = f"If LeRobot's tools edited it: astra-data repair {quote(str(root))} --like ORIGINAL --out DIR\n"
        advice += f"To recover its intact episodes: astra-data repair {quote(str(root))} --out DIR"
        raise CorruptDatasetError(f"{message}\n{advice}")
    typer.echo(f"{printable(str(root))} is intact: {report.episodes} episodes, {report.frames} steps")
    try:
        whole = Dataset.open(root)
    except BadInputError as error:  # intact, but no robot's trajectories
        typer.echo(f"note: {printable(str(error))}")
        return
    if TERMINATED in whole.features:
        typer.echo(f"episodes end: {endings_of(whole)}")


def repair(
    dataset: arguments.DatasetName,
    out: Annotated[Path, typer.Option(help="Folder of the new dataset.")],
    like: Annotated[
        list[str] | None,
        typer.Option(metavar="ORIGINAL", help="What LeRobot's tools made DATASET from: its metadata are copied."),
    ] = None,
    new_uids: Annotated[bool, typer.Option("--new-uids", help="Keep episodes of taken uids, under new ones.")] = False,
) -> None:
    """Recover the intact episodes of a damaged dataset, of astra-data or LeRobot, into a new one."""
    from astra_data.dataset.doctor.repair import repair as save
    from astra_data.dataset.versions import locate, open_dataset

    sources = [open_dataset(original) for original in like or ()]
    repaired = save(locate(dataset), out=out, like=sources, new_uids=new_uids)
    for note in repaired.notes:
        typer.echo(f"note: {printable(note)}")
    typer.echo(f"finished: {printable(str(out))} ({repaired.episodes} episodes, {repaired.frames} steps)")


def log(
    dataset: arguments.DatasetName,
    other: Annotated[str | None, typer.Argument(metavar="[OTHER]", help="Show how this one differs from it.")] = None,
) -> None:
    """Show what a dataset was made from, as a tree; or how two differ: columns, episodes by uid, origin."""
    from astra_data.dataset.versions import differences, lineage, open_dataset, tree_lines

    first = open_dataset(dataset)
    if other is None:
        typer.echo("\n".join(tree_lines(lineage(first))))
        return
    second = open_dataset(other)
    found = differences(first, second)
    for one in (first, second):
        typer.echo(f"{one.reference}: {len(one)} episodes, {one.lengths.sum()} steps")
    only = {f"only in {first.reference}": found.only_in_a, f"only in {second.reference}": found.only_in_b}
    for title, uids in (only | {"differ in values": found.values}).items():
        if uids:
            typer.echo(f"{len(uids)} episodes {title}: {', '.join(map(str, uids))}")
    if found.metadata:
        if not found.values:
            typer.echo("0 episodes differ in values")
        keys = ", ".join(f"{printable(key)} ({first_few(uids, 5)})" for key, uids in found.metadata.items())
        typer.echo(f"{len(set().union(*found.metadata.values()))} episodes differ in metadata: {keys}")
    for sentence in (*found.schema, *found.description):
        typer.echo(printable(sentence))
