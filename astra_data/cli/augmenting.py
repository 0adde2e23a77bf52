"""`astra-data augment`."""

from typing import Annotated, Any

import typer

from astra_data.cli.arguments import DatasetName, NewName, Out
from astra_data.cli.settings import with_settings


@with_settings("astra_data.pipeline.stages.augment:AugmentConfig")
def augment(
    dataset: DatasetName,
    settings: dict[str, Any],
    task: Annotated[
        str | None,
        typer.Option(
            help="Task that computes the rewards and endings of the copies.",
            show_default="the dataset's own task",
        ),
    ] = None,
    name: NewName = None,
    out: Out = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Add rotated and shifted copies of episodes; the dataset must not be paired yet."""
    from astra_data.dataset.versions import locate

    root = locate(dataset)
    from astra_data.core.config import validated
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.stages.augment import AugmentConfig
    from astra_data.pipeline.stages.augment import augment as augment_dataset

    config = validated(settings, AugmentConfig, "augment")
    with shown("augment") as progress:
        folder = augment_dataset(task, config, dataset=root, seed=seed, name=name, out=out, progress=progress)
    typer.echo(f"finished: {folder}")
