"""Commands that exchange datasets with other formats and other people."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from astra_data.cli.arguments import DatasetName, Out
from astra_data.core.errors import BadInputError

NotesPath = Annotated[Path | None, typer.Option(help="TOML file: license, summary, behavior, intended_use, limits.")]


def import_(
    recordings: Annotated[list[Path], typer.Argument(metavar="SOURCE", help="Files, folders, archives: one format.")],
    mapping: Annotated[
        Path | None, typer.Option(help="TOML file: which fields become which columns. D4RL, Minari and more need none.")
    ] = None,
    file_format: Annotated[
        str | None,
        typer.Option("--format", help="csv, hdf5, json, mcap, minari, npz, parquet or torch.", show_default="by name"),
    ] = None,
    out: Out = None,
    name: Annotated[str | None, typer.Option(help="Name of the dataset.", show_default="the mapping's")] = None,
    fps: Annotated[int | None, typer.Option(min=1, help="Steps per second.", show_default="the mapping's")] = None,
    task: Annotated[str | None, typer.Option(help="What the robot does.", show_default="the mapping's")] = None,
    max_bytes: Annotated[
        int | None, typer.Option(min=1, help="Refuse what unpacks to more bytes.", show_default="100 times, or 256 MB")
    ] = None,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out, and list, what cannot be imported.")] = False,
) -> None:
    """Convert logs (CSV, NPZ, HDF5, Parquet, Minari, MCAP, JSON, PyTorch) to a dataset."""
    from astra_data.core.naming import printable
    from astra_data.io.importing import import_dataset

    given: dict[str, Any] = {"name": name, "fps": fps, "task": task, "file_format": file_format}
    report = import_dataset(recordings, mapping, out=out, max_bytes=max_bytes, skip_bad=skip_bad, **given)
    typer.echo("\n".join(map(printable, f"finished: {report}".split("\n"))))


def export(
    dataset: DatasetName,
    format: Annotated[str, typer.Option(help="minari, d4rl, robomimic or d3rlpy; or card: its dataset card.")],
    out: Annotated[Path, typer.Option(help="The new file; for minari a folder, such as maze/random-v0.")],
    notes: NotesPath = None,
) -> None:
    """Convert a dataset to the format of another library, or write its card: contents, origin, loading."""
    from astra_data.dataset.versions import open_dataset

    opened = open_dataset(dataset)
    if format != "card":
        from astra_data.io.exporters import export as write

        if notes is not None:
            raise BadInputError("--notes are for --format card and for push: leave them out")
        write(opened, out, format=format)
        typer.echo(f"finished: {out}")
        return
    from astra_data.core.config import load_recipe
    from astra_data.io.hub.card import Notes, write_card

    written = load_recipe(notes, Notes) if notes else Notes()
    opened.require_whole()
    for path in write_card(opened, out, written):
        typer.echo(f"written: {path}")


if TYPE_CHECKING:
    from astra_data.dataset.reader import Dataset


def push(
    dataset: DatasetName,
    url: Annotated[str, typer.Argument(metavar="URL", help="user/name (Hugging Face Hub), s3://, gs:// or ./shared")],
    notes: NotesPath = None,
    private: Annotated[bool, typer.Option("--private", help="Create the repository on the Hub as private.")] = False,
) -> None:
    """Share a version of a dataset, with its card; a shared version never changes."""
    from astra_data.dataset.versions import open_dataset
    from astra_data.io.hub.sharing import push as send
    from astra_data.pipeline.display import shown

    with shown("push") as progress:
        source = send(dataset, url, notes=notes, private=private, progress=progress)
    typer.echo(f"shared: {source}")
    if made := _made_from_namesake(open_dataset(dataset)):
        typer.echo(f"note: it was {made}; who pulls without a version gets the newest that is there")


def pull(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="user/name on the Hugging Face Hub, URL, or path.")],
    out: Out = None,
    version: Annotated[str | None, typer.Option(help="Version, such as 1.2.0.", show_default="the newest")] = None,
    max_bytes: Annotated[int | None, typer.Option(min=1, help="Refuse more bytes.", show_default="100 GB")] = None,
) -> None:
    """Download and verify a shared dataset; run again to continue, or to verify the copy."""
    from astra_data.io.hub.sharing import MOST_BYTES
    from astra_data.io.hub.sharing import pull as fetch
    from astra_data.pipeline.display import shown

    with shown("pull") as progress:
        dataset = fetch(source, out=out, version=version, max_bytes=max_bytes or MOST_BYTES, progress=progress)
    typer.echo(f"{dataset.reference}: {dataset.root}")
    if made := _made_from_namesake(dataset):
        typer.echo(f"note: it was {made}; --version takes another")


def _made_from_namesake(dataset: "Dataset") -> str:
    """Say by which stage a dataset was made from one of the same name, as a subset is; "" if it was not."""
    from astra_data.dataset.description import full_name

    description = dataset.description
    alike = [full_name(one) for one in description["parents"] if one["name"] == description["name"]]
    return f"made by {description['stage']} from {alike[0]}" if alike else ""
