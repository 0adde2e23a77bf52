"""Commands of stages that make datasets: for a recipe, or for a task or a dataset on their own."""

from pathlib import Path
from typing import Annotated, Any

import typer

from astra_data.cli import arguments
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS


@arguments.with_settings("astra_data.pipeline.stages.collect:CollectConfig")
def collect(
    task: arguments.TaskOrRecipe,
    settings: dict[str, Any],
    seeds: Annotated[
        list[int] | None,
        typer.Option("--seed", help="Random seed; of a recipe, run only this one.", show_default="0; all of a recipe"),
    ] = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
    name: Annotated[str | None, typer.Option(help="Its name.", show_default="task, behavior and seed")] = None,
    out: arguments.Out = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the same command after an interruption.")] = False,
) -> None:
    """Record episodes in the target environment."""
    if task.endswith(".toml"):
        arguments.refuse({**settings, "name": name, "out": out, "resume": resume or None}, "collect")
        arguments.run_stage(Path(task), "collect", seeds=seeds, jobs=jobs, root=root)
        return
    seed = arguments.refuse_of_recipes("collect", seeds, jobs) or 0
    arguments.task_at(task)
    import torch

    # The networks' idle threads would slow down the physics.
    torch.set_num_threads(1)
    with arguments.resumable("run the same command with --resume to continue"):
        _make("collect", task, settings, seed=seed, out=out, name=name, resume=resume)


@arguments.with_settings("astra_data.pipeline.stages.pair:PairConfig")
def pair(
    dataset: arguments.Source,
    settings: dict[str, Any],
    seeds: arguments.Seeds = None,
    jobs: arguments.Jobs = None,
    root: arguments.Root = RUNS,
    simulator: Annotated[
        str | None,
        typer.Option(help="A task, an installed simulator, or your own class: path.py:MySimulator. Its code is run."),
    ] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Add the abstract simulator's next state, from the same state and action, to every step."""
    if dataset.endswith(".toml"):
        arguments.refuse({**settings, "simulator": simulator, "name": name, "out": out}, "pair")
        arguments.run_stage(Path(dataset), "pair", seeds=seeds, jobs=jobs, root=root)
        return
    if seeds or jobs is not None:
        raise BadInputError("pair: with a dataset, leave out --seed and --jobs (these are for recipes)")
    if simulator is None:
        raise BadInputError("pair: expected --simulator: a task or path.py:MySimulator")
    arguments.task_at(simulator)
    from astra_data.dataset.versions import locate

    _make("pair", simulator, settings, dataset=locate(dataset), name=name, out=out)


@arguments.with_settings("astra_data.pipeline.stages.augment:AugmentConfig")
def augment(
    dataset: arguments.DatasetName,
    settings: dict[str, Any],
    task: Annotated[
        str | None, typer.Option(help="Task that computes rewards and ends of copies.", show_default="the dataset's")
    ] = None,
    name: arguments.NewName = None,
    out: arguments.Out = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Add rotated and shifted copies of episodes; the dataset must not be paired yet."""
    from astra_data.dataset.versions import locate

    _make("augment", task, settings, dataset=locate(dataset), seed=seed, name=name, out=out)


def label(
    dataset: arguments.DatasetName,
    task: Annotated[str, typer.Option(help="A task: a name, or a place such as cart.py:TASK. Its code is run.")],
    seed: Annotated[int, typer.Option(help="Random seed of the goals.")] = 0,
    name: arguments.NewName = None,
    out: arguments.Out = None,
) -> None:
    """Compute the goals, rewards, successes and failures that a log lacks, as a task defines them."""
    arguments.task_at(task)
    from astra_data.dataset.versions import locate

    _make("label", task, None, data=locate(dataset), seed=seed, name=name, out=out)


def _make(stage: str, task: str | None, settings: dict[str, Any] | None, **options: object) -> None:
    """Run one stage on its own, and print the folder that it writes."""
    from importlib import import_module

    from astra_data.core.config import validated
    from astra_data.pipeline.display import shown

    module = import_module(f"astra_data.pipeline.stages.{stage}")
    if settings is not None:
        options["config"] = validated(settings, getattr(module, f"{stage.title()}Config"), stage)
    with shown(stage) as progress:
        folder = getattr(module, stage)(task, progress=progress, **options)
    typer.echo(f"finished: {folder}")
