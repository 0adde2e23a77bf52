"""`astra-data subset`, `merge`, `delete` and `filter`: new versions with other episodes."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName, Jobs, NewName, Out, Root, Source
from astra_data.cli.recipes import refuse, run_stage
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS


def subset(
    dataset: Source,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Number of episodes to keep.", show_default=False)
    ] = None,
    percent: Annotated[
        int | None,
        typer.Option(min=1, help="The same as a percentage of --of; may exceed 100.", show_default=False),
    ] = None,
    of: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of episodes that counts as 100 percent.",
            show_default="all episodes of DATASET",
        ),
    ] = None,
    seeds: Annotated[
        list[int] | None,
        typer.Option(
            "--seed",
            help="Seed of the random choice; with a recipe, run only this of its seeds (may be repeated).",
            show_default="the one stored in DATASET; all seeds of a recipe",
        ),
    ] = None,
    stratify: Annotated[
        str | None,
        typer.Option(
            help="Key of the episodes' metadata, such as success, whose values keep their proportions.",
            show_default=False,
        ),
    ] = None,
    name: NewName = None,
    out: Out = None,
    jobs: Jobs = None,
    root: Root = RUNS,
) -> None:
    """Write a random subset; with the same seed, smaller subsets are contained in larger ones."""
    if dataset.endswith(".toml"):
        options = {"episodes": episodes, "percent": percent, "of": of, "stratify": stratify}
        refuse(options | {"name": name, "out": out}, "subset", "sweep")
        run_stage(Path(dataset), "subset", seeds=seeds or (), jobs=jobs, root=root)
        return
    if len(seeds or ()) > 1 or jobs is not None:
        raise BadInputError(
            "subset: with a dataset, give at most one --seed and no --jobs (these are for recipes)"
        )
    from astra_data.dataset.edit import subset as write
    from astra_data.dataset.versions import open_dataset

    source = open_dataset(dataset)
    _report(
        write(
            source,
            episodes=episodes,
            percent=percent,
            of=of,
            seed=seeds[0] if seeds else None,
            stratify=stratify,
            name=name,
            out=out,
        )
    )


def merge(
    datasets: Annotated[
        list[str],
        typer.Argument(
            metavar="DATASET",
            help="Two or more datasets with the same columns, fps, task, environment and simulator.",
        ),
    ],
    new_uids: Annotated[
        bool, typer.Option("--new-uids", help="Give new uids to episodes whose uid is already taken.")
    ] = False,
    name: NewName = None,
    out: Out = None,
) -> None:
    """Merge the episodes of several datasets into one."""
    from astra_data.dataset.edit import merge as write
    from astra_data.dataset.versions import open_dataset

    _report(write([open_dataset(dataset) for dataset in datasets], new_uids=new_uids, name=name, out=out))


def delete(
    dataset: DatasetName,
    uids: Annotated[
        list[int],
        typer.Option(
            "--episode", metavar="UID", help="Uid of an episode; may be repeated.", show_default=False
        ),
    ],
    name: NewName = None,
    out: Out = None,
) -> None:
    """Write a dataset without some of its episodes."""
    from astra_data.dataset.edit import delete as write
    from astra_data.dataset.versions import open_dataset

    _report(write(open_dataset(dataset), uids, name=name, out=out))


def filter_(
    dataset: DatasetName,
    success: Annotated[
        bool | None,
        typer.Option(
            "--success/--no-success", help="Keep only successes, or only failures.", show_default=False
        ),
    ] = None,
    min_return: Annotated[float | None, typer.Option(help="Minimum return.", show_default=False)] = None,
    max_return: Annotated[float | None, typer.Option(help="Maximum return.", show_default=False)] = None,
    min_length: Annotated[int | None, typer.Option(help="Minimum steps.", show_default=False)] = None,
    max_length: Annotated[int | None, typer.Option(help="Maximum steps.", show_default=False)] = None,
    name: NewName = None,
    out: Out = None,
) -> None:
    """Write a dataset of the episodes that meet every given condition."""
    from astra_data.dataset.edit import filter_episodes
    from astra_data.dataset.versions import open_dataset

    _report(
        filter_episodes(
            open_dataset(dataset),
            success=success,
            min_return=min_return,
            max_return=max_return,
            min_length=min_length,
            max_length=max_length,
            name=name,
            out=out,
        )
    )


def _report(folder: Path) -> None:
    from astra_data.dataset.reader import Dataset
    from astra_data.dataset.versions import home_of, versions_at_home

    written = Dataset.open(folder)
    typer.echo(
        f"finished: {folder} ({written.reference}, {len(written)} episodes, {written.lengths.sum()} steps)"
    )
    name, version = written.description["name"], written.description["version"]
    versions = [str(known) for known in versions_at_home(name)]
    if folder == home_of(written.description) and versions[-1] == version and len(versions) > 1:
        typer.echo(
            f"note: {name} now means this version, no longer data-{versions[-2]}; --name keeps both apart"
        )
