"""`astra-data log` and `astra-data diff`."""

from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName
from astra_data.core.wording import first_few, printable

_SHOWN = 5
"""Uids of episodes whose metadata differ."""


def log(dataset: DatasetName) -> None:
    """Show what a dataset was made from: a tree of datasets with versions, hashes, stages and settings."""
    from astra_data.dataset.lineage import lineage, tree_lines
    from astra_data.dataset.versions import open_dataset

    for line in tree_lines(lineage(open_dataset(dataset))):
        typer.echo(line)


def diff(
    a: DatasetName,
    b: Annotated[str, typer.Argument(metavar="DATASET", help="The other one.", show_default=False)],
) -> None:
    """Show how two datasets differ: columns, episodes by uid, origin."""
    from astra_data.dataset.compare import differences
    from astra_data.dataset.versions import open_dataset

    first, second = open_dataset(a), open_dataset(b)
    found = differences(first, second)
    for dataset in (first, second):
        typer.echo(f"{dataset.reference}: {len(dataset)} episodes, {dataset.lengths.sum()} steps")
    listed = {
        f"only in {first.reference}": found.only_in_a,
        f"only in {second.reference}": found.only_in_b,
        "differ in values": found.values,
    }
    for title, uids in listed.items():
        if uids:
            typer.echo(f"{len(uids)} episodes {title}: {', '.join(map(str, uids))}")
    if found.metadata:
        if not found.values:
            typer.echo("0 episodes differ in values")
        keys = ", ".join(
            f"{printable(key)} ({first_few(uids, _SHOWN)})" for key, uids in found.metadata.items()
        )
        different = set().union(*found.metadata.values())
        typer.echo(f"{len(different)} episodes differ in metadata: {keys}")
    for sentence in (*found.schema, *found.description):
        typer.echo(printable(sentence))
