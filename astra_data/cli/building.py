"""`astra-data collect`, `pair` and `augment`, for a recipe or on their own."""

from pathlib import Path
from typing import Annotated, Any

import typer

from astra_data.cli.arguments import (
    DatasetName,
    Jobs,
    NewName,
    Out,
    Root,
    Seeds,
    Source,
    task_at,
    with_settings,
)
from astra_data.cli.recipes import refuse, resumable, run_stage
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS

Task = Annotated[
    str,
    typer.Argument(
        metavar="RECIPE|TASK",
        help="A recipe (.toml), or a task such as antmaze-umaze. "
        "The settings below apply to a task only; a recipe has its own.",
        show_default=False,
    ),
]
SeedOrSeeds = Annotated[
    list[int] | None,
    typer.Option(
        "--seed",
        help="Random seed; with a recipe, run only this one of its seeds (may be repeated).",
        show_default="0; all seeds of a recipe",
    ),
]
Name = Annotated[
    str | None, typer.Option(help="Name of the dataset.", show_default="task, behavior and seed")
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the same command after an interruption.")]


@with_settings("astra_data.pipeline.stages.collect:CollectConfig")
def collect(
    task: Task,
    settings: dict[str, Any],
    seeds: SeedOrSeeds = None,
    jobs: Jobs = None,
    root: Root = RUNS,
    name: Name = None,
    out: Out = None,
    resume: Resume = False,
) -> None:
    """Record episodes in the target environment."""
    if task.endswith(".toml"):
        refuse({**settings, "name": name, "out": out, "resume": resume or None}, "collect")
        run_stage(Path(task), "collect", seeds=seeds or (), jobs=jobs, root=root)
        return
    if len(seeds or ()) > 1 or jobs is not None:
        raise BadInputError(
            "collect: with a task, give at most one --seed and no --jobs (these are for recipes)"
        )
    task_at(task)
    import torch

    from astra_data.core.config import validated
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.stages.collect import CollectConfig
    from astra_data.pipeline.stages.collect import collect as collect_dataset

    planned = {"behavior": "planned"} if "plan" in settings and "behavior" not in settings else {}
    config = validated(settings | planned, CollectConfig, "collect")
    seed = seeds[0] if seeds else 0
    # The networks' idle threads would slow down the physics.
    torch.set_num_threads(1)
    how = "run the same command with --resume to continue"
    with resumable(how), shown("collect") as progress:
        folder = collect_dataset(
            task, config, seed=seed, out=out, name=name, resume=resume, progress=progress
        )
    typer.echo(f"finished: {folder}")


@with_settings("astra_data.pipeline.stages.pair:PairConfig")
def pair(
    dataset: Source,
    settings: dict[str, Any],
    seeds: Seeds = None,
    jobs: Jobs = None,
    root: Root = RUNS,
    simulator: Annotated[
        str | None,
        typer.Option(
            help="A task (to use its abstract simulator), a simulator of an installed package, or your own "
            "class: path.py:MySimulator. Its code is run.",
            show_default=False,
        ),
    ] = None,
    name: NewName = None,
    out: Out = None,
) -> None:
    """Add the abstract simulator's next state, from the same state and action, to every step."""
    if dataset.endswith(".toml"):
        refuse({**settings, "simulator": simulator, "name": name, "out": out}, "pair")
        run_stage(Path(dataset), "pair", seeds=seeds or (), jobs=jobs, root=root)
        return
    if seeds or jobs is not None:
        raise BadInputError("pair: with a dataset, leave out --seed and --jobs (these are for recipes)")
    if simulator is None:
        raise BadInputError("pair: expected --simulator: a task or path.py:MySimulator")
    task_at(simulator)
    from astra_data.dataset.versions import locate

    source = locate(dataset)
    from astra_data.core.config import validated
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.stages.pair import PairConfig
    from astra_data.pipeline.stages.pair import pair as pair_dataset

    config = validated(settings, PairConfig, "pair")
    with shown("pair") as progress:
        folder = pair_dataset(simulator, config, dataset=source, name=name, out=out, progress=progress)
    typer.echo(f"finished: {folder}")


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
