"""`astra-data collect` and `astra-data pair`, for a recipe or on their own."""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.cli.arguments import NewName, Out, Source
from astra_data.cli.recipes import Jobs, Root, Seeds, refuse, resumable, run_stage
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
Behavior = Annotated[
    str | None,
    typer.Option(help="random, stress, policy, suboptimal_ppo or suboptimal_sac.", show_default="random"),
]
Episodes = Annotated[int | None, typer.Option(help="Number of episodes.", show_default="200")]
LeastSteps = Annotated[
    int | None,
    typer.Option(help="Stop once the episodes have this many steps in total.", show_default="all episodes"),
]
MaxSteps = Annotated[int | None, typer.Option(help="Maximum steps per episode.", show_default="500")]
Start = Annotated[
    str | None, typer.Option(help="Where episodes start: anywhere or task.", show_default="anywhere")
]
Hold = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="LEAST LARGEST", help="How long each random command is held, in s.", show_default="0.5 3"
    ),
]
PpoSteps = Annotated[
    int | None, typer.Option(help="Environment steps that suboptimal_ppo learns for.", show_default="300000")
]
SacSteps = Annotated[
    int | None,
    typer.Option(help="Maximum environment steps that suboptimal_sac learns for.", show_default="300000"),
]
SacEpisodeSteps = Annotated[
    int | None,
    typer.Option(
        help="Stop suboptimal_sac once its mean episode length, in steps, reaches this.", show_default="500"
    ),
]
RandomShare = Annotated[
    float | None,
    typer.Option(help="With a policy: fraction of episodes with random commands instead.", show_default="0"),
]
Clearance = Annotated[
    float | None,
    typer.Option(
        help="Replace random commands that would lead closer to walls than this, in m.", show_default="0"
    ),
]
Policy = Annotated[
    str | None,
    typer.Option(
        help="Folder of the policy: written by train, or meta/astra of a dataset.", show_default=False
    ),
]
Grounding = Annotated[
    str | None, typer.Option(help="Folder of the policy's grounding, if it has one.", show_default=False)
]
Encoder = Annotated[
    str | None, typer.Option(help="Folder of the policy's target encoder, if it has one.", show_default=False)
]
Name = Annotated[
    str | None, typer.Option(help="Name of the dataset.", show_default="task, behavior and seed")
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the same command after an interruption.")]


def collect(
    task: Task,
    seeds: SeedOrSeeds = None,
    jobs: Jobs = None,
    root: Root = RUNS,
    behavior: Behavior = None,
    episodes: Episodes = None,
    least_steps: LeastSteps = None,
    max_steps: MaxSteps = None,
    start: Start = None,
    hold_s: Hold = None,
    ppo_steps: PpoSteps = None,
    sac_steps: SacSteps = None,
    sac_episode_steps: SacEpisodeSteps = None,
    random_share: RandomShare = None,
    clearance_m: Clearance = None,
    policy: Policy = None,
    grounding: Grounding = None,
    target_encoder: Encoder = None,
    name: Name = None,
    out: Out = None,
    resume: Resume = False,
) -> None:
    """Record episodes in the target environment."""
    from astra_data.core.config import only_given, validated

    given = only_given(
        behavior=behavior,
        episodes=episodes,
        least_steps=least_steps,
        max_steps=max_steps,
        start=start,
        hold_s=hold_s,
        ppo_steps=ppo_steps,
        sac_steps=sac_steps,
        sac_episode_steps=sac_episode_steps,
        random_share=random_share,
        clearance_m=clearance_m,
        policy=policy,
        grounding=grounding,
        target_encoder=target_encoder,
    )
    if task.endswith(".toml"):
        refuse({**given, "name": name, "out": out, "resume": resume or None}, "collect")
        run_stage(Path(task), "collect", seeds=seeds or (), jobs=jobs, root=root)
        return
    if len(seeds or ()) > 1 or jobs is not None:
        raise BadInputError(
            "collect: with a task, give at most one --seed and no --jobs (these are for recipes)"
        )
    import torch

    from astra_data.experiments.display import shown
    from astra_data.stages.collect import CollectConfig
    from astra_data.stages.collect import collect as collect_dataset

    config = validated(given, CollectConfig, "collect")
    seed = seeds[0] if seeds else 0
    # The networks' idle threads would slow down the physics.
    torch.set_num_threads(1)
    how = "run the same command with --resume to continue"
    with resumable(how), shown("collect") as progress:
        folder = collect_dataset(
            task, config, seed=seed, out=out, name=name, resume=resume, progress=progress
        )
    typer.echo(f"finished: {folder}")


def pair(
    dataset: Source,
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
    reset_tolerance: Annotated[
        float | None,
        typer.Option(
            help="Maximum difference between φ(s) and the simulator's state after a reset.",
            show_default="1e-6",
        ),
    ] = None,
    name: NewName = None,
    out: Out = None,
) -> None:
    """Add the abstract simulator's next state, from the same state and action, to every step."""
    from astra_data.core.config import only_given, validated

    given = only_given(reset_tolerance=reset_tolerance)
    if dataset.endswith(".toml"):
        refuse({**given, "simulator": simulator, "name": name, "out": out}, "pair")
        run_stage(Path(dataset), "pair", seeds=seeds or (), jobs=jobs, root=root)
        return
    if seeds or jobs is not None:
        raise BadInputError("pair: with a dataset, leave out --seed and --jobs (these are for recipes)")
    from astra_data.dataset.versions import locate
    from astra_data.experiments.display import shown
    from astra_data.stages.pair import PairConfig
    from astra_data.stages.pair import pair as pair_dataset

    config = validated(given, PairConfig, "pair")
    if simulator is None:
        raise BadInputError("pair: expected --simulator: a task or path.py:MySimulator")
    with shown("pair") as progress:
        folder = pair_dataset(
            simulator, config, dataset=locate(dataset), name=name, out=out, progress=progress
        )
    typer.echo(f"finished: {folder}")
