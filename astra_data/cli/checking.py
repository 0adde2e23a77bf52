"""`astra-data validate` and `astra-data repair`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName
from astra_data.core.wording import printable


def validate(
    dataset: DatasetName,
    with_lerobot: Annotated[
        bool, typer.Option("--with-lerobot", help="Also compare with what lerobot's own loader reads (slow).")
    ] = False,
) -> None:
    """Check every file and value of a LeRobot dataset and list all errors."""
    from astra_data.core.errors import BadInputError, CorruptDatasetError
    from astra_data.dataset.columns import TERMINATED
    from astra_data.dataset.doctor.check import check
    from astra_data.dataset.doctor.lerobot_loader import compare_with_lerobot
    from astra_data.dataset.endings import endings_of
    from astra_data.dataset.opening import can_be_repaired
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
        if can_be_repaired(root):
            message += f"\nTo recover its intact episodes: astra-data repair {root} --out DIR"
        raise CorruptDatasetError(message)
    typer.echo(f"{printable(str(root))} is intact: {report.episodes} episodes, {report.frames} steps")
    try:
        whole = Dataset.open(root)
    except BadInputError as error:  # intact, but no robot's trajectories
        typer.echo(f"note: {printable(str(error))}")
        return
    if TERMINATED in whole.features:
        typer.echo(f"episodes end: {endings_of(whole)}")


def repair(
    dataset: DatasetName,
    out: Annotated[Path, typer.Option(help="Folder of the new dataset.", show_default=False)],
    like: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGINAL",
            help="The dataset that LeRobot's tools made DATASET from. Its origin and its episodes' metadata "
            "are copied to episodes with the same uid and values. After a merge, give each dataset merged.",
            show_default=False,
        ),
    ] = None,
    new_uids: Annotated[
        bool, typer.Option("--new-uids", help="Keep episodes whose uid is already taken, under new uids.")
    ] = False,
) -> None:
    """Recover the intact episodes of a damaged dataset, of astra-data or LeRobot, into a new one."""
    from astra_data.dataset.doctor.repair import repair as save
    from astra_data.dataset.versions import locate, open_dataset

    sources = [open_dataset(original) for original in like or ()]
    repaired = save(locate(dataset), out=out, like=sources, new_uids=new_uids)
    for note in repaired.notes:
        typer.echo(f"note: {printable(note)}")
    typer.echo(f"finished: {printable(str(out))} ({repaired.episodes} episodes, {repaired.frames} steps)")
