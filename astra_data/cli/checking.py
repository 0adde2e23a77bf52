"""`astra-data validate` and `astra-data repair`."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName


def validate(
    dataset: DatasetName,
    with_lerobot: Annotated[
        bool, typer.Option("--with-lerobot", help="Also compare windows with lerobot's own loader; slow.")
    ] = False,
) -> None:
    """Check every file and value of a LeRobot dataset, and list all faults."""
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
        typer.echo(f"note: {note}")
    if report.faults:
        count = "1 fault" if report.fault_count == 1 else f"{report.fault_count} faults"
        message = "\n  ".join([f"{root} has {count}:", *report.faults])
        if can_be_repaired(root):
            message += f"\nTo save its whole episodes: astra-data repair {root} --out DIR"
        raise CorruptDatasetError(message)
    typer.echo(f"{root} is whole: {report.episodes} episodes, {report.frames} steps")
    try:
        whole = Dataset.open(root)
    except BadInputError as error:  # whole, but no robot's trajectories
        typer.echo(f"note: {error}")
        return
    if TERMINATED in whole.features:
        typer.echo(f"episodes end: {endings_of(whole)}")


def repair(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="The folder of a LeRobot dataset; it is not changed.", show_default=False
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the new dataset.", show_default=False)],
    like: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DATASET",
            help="The dataset from which FOLDER was made by LeRobot's tools: its origin and its episodes' "
            "metadata are copied, matched by uid and values. After a merge, once for each dataset merged.",
            show_default=False,
        ),
    ] = None,
    new_uids: Annotated[
        bool, typer.Option("--new-uids", help="Keep episodes whose uid is taken, under new ones.")
    ] = False,
) -> None:
    """Save the intact episodes of a broken dataset, of astra-data or LeRobot, to a new one."""
    from astra_data.dataset.doctor.repair import repair as save
    from astra_data.dataset.versions import open_dataset

    sources = [open_dataset(dataset) for dataset in like or ()]
    repaired = save(folder, out=out, like=sources, new_uids=new_uids)
    for note in repaired.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"finished: {out} ({repaired.episodes} episodes, {repaired.frames} steps)")
