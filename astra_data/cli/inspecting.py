"""`astra-data inspect` and `astra-data list`."""

from json import dumps
from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName
from astra_data.cli.showing import show_table
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError


def inspect(
    dataset: DatasetName,
    plot: Annotated[
        Path | None,
        typer.Option(help="Folder for figures of positions and velocities.", show_default="no figures"),
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option(
            help="File for the check-up's findings, each with all its episodes.", show_default="no file"
        ),
    ] = None,
) -> None:
    """Show a dataset's values, episodes, a map of visited positions, and what looks wrong."""
    from rich.console import Console

    from astra_data.cli.inspection_page import inspection_page
    from astra_data.dataset.checkup.checkup import check_up
    from astra_data.dataset.inspection import inspect_dataset
    from astra_data.dataset.versions import open_dataset

    found = open_dataset(dataset)
    inspection, checkup = inspect_dataset(found), check_up(found, quote(dataset))
    Console(soft_wrap=True).print(inspection_page(inspection, checkup))
    if json is not None:
        write_file(json, dumps(checkup.record(), indent=1, ensure_ascii=False) + "\n")
        typer.echo(f"written: {json}")
    if plot is None:
        return
    from astra_data.reports.figures.catalog import coverage, png

    maps = ((inspection.positions, "position", "m"), (inspection.velocities, "velocity", "m/s"))
    drawn = [(planar, label, unit) for planar, label, unit in maps if planar is not None]
    if not drawn:
        raise BadInputError(
            f"{inspection.reference}: expected a state with the role position or vector, found none: "
            "give its columns a role in the mapping, or leave out --plot"
        )
    for planar, label, unit in drawn:
        path = plot / f"{label}_coverage.png"
        write_file(path, png(coverage(planar.counts, planar.extent, label, unit)))
        typer.echo(f"written: {path}")


def list_(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FOLDER", help="More folders for --clean, such as runs.", show_default=False),
    ] = None,
    clean: Annotated[
        bool,
        typer.Option(
            "--clean", help="Instead, remove leftovers of killed commands from the home folder and FOLDER."
        ),
    ] = False,
) -> None:
    """List the datasets in the home folder, and their versions."""
    if clean:
        _clean(folders or [])
        return
    if folders:
        raise BadInputError(
            "list: folders are for --clean; without it, list shows the datasets in the home folder"
        )
    from rich.table import Table

    from astra_data.core.errors import AstraDataError, CorruptDatasetError
    from astra_data.core.wording import printable
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
            facts = (
                printable(found.description["stage"]),
                f"{len(found):,}",
                f"{steps:,}",
                found.content_hash[:12],
            )
            table.add_row(found.reference, *facts)
    show_table(table)
    if faults:
        raise CorruptDatasetError("\n".join(faults))


def _clean(folders: list[Path]) -> None:
    from astra_data.core.durable import clean
    from astra_data.core.wording import printable
    from astra_data.dataset.versions import home

    notes = {
        "removed": "",
        "in use": ": another command is writing it",
        "kept": ": the interrupted command can continue from it; otherwise delete it",
    }
    if home().exists():
        folders = [home(), *folders]
    if missing := [str(folder) for folder in folders if not folder.is_dir()]:
        raise BadInputError(f"list --clean: expected folders, got {', '.join(missing)}")
    found = dict(item for folder in folders for item in clean(folder))
    for path, state in found.items():
        typer.echo(f"{state}: {printable(str(path))}{notes[state]}")
    if not found:
        typer.echo("found no leftovers of killed commands")
