"""`astra-data augment`."""

from typing import Annotated

import typer

from astra_data.cli.arguments import DatasetName, NewName, Out


def augment(
    dataset: DatasetName,
    task: Annotated[
        str | None,
        typer.Option(
            help="Task that computes the rewards and endings of the copies.",
            show_default="the dataset's own task",
        ),
    ] = None,
    name: NewName = None,
    out: Out = None,
    copies: Annotated[
        int | None, typer.Option(help="Copies of each training episode.", show_default="3")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Total number of episodes, instead of --copies.", show_default=False)
    ] = None,
    rotations: Annotated[
        str | None, typer.Option(help="any (angle), quarter (turns), or none.", show_default="any")
    ] = None,
    translations: Annotated[
        bool | None,
        typer.Option(
            "--translations/--no-translations",
            help="Start copies anywhere in the maze, or where the original started.",
            show_default="translations",
        ),
    ] = None,
    held_out_share: Annotated[
        float | None,
        typer.Option(help="Fraction of episodes to hold out; they are never copied.", show_default="0.1"),
    ] = None,
    keep_originals: Annotated[
        bool | None,
        typer.Option(
            "--keep-originals/--drop-originals",
            help="Keep the training episodes, or only their copies.",
            show_default="keep-originals",
        ),
    ] = None,
    margin_m: Annotated[
        float | None, typer.Option(help="Minimum distance to walls, in m.", show_default="the robot's reach")
    ] = None,
    min_steps: Annotated[int | None, typer.Option(help="Minimum steps of a copy.", show_default="20")] = None,
    tries: Annotated[
        int | None, typer.Option(help="Rotations to try per copy before giving up.", show_default="100")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Add rotated and shifted copies of episodes; the dataset must not be paired yet."""
    from astra_data.core.config import only_given, validated
    from astra_data.dataset.versions import locate
    from astra_data.experiments.display import shown
    from astra_data.stages.augment import AugmentConfig
    from astra_data.stages.augment import augment as augment_dataset

    given = only_given(
        copies=copies,
        episodes=episodes,
        rotations=rotations,
        translations=translations,
        held_out_share=held_out_share,
        keep_originals=keep_originals,
        margin_m=margin_m,
        min_steps=min_steps,
        tries=tries,
    )
    config = validated(given, AugmentConfig, "augment")
    with shown("augment") as progress:
        folder = augment_dataset(
            task, config, dataset=locate(dataset), seed=seed, name=name, out=out, progress=progress
        )
    typer.echo(f"finished: {folder}")
