"""Train again where a policy did not master the simulator that it was trained in; the target has no say."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from astra_data.core.progress import part
from astra_data.core.seeding import derive
from astra_data.core.stopwatch import CLOCKS
from astra_data.grounding.files import grounding_at
from astra_data.policies.own_world import Reached, reached_in_own_world
from astra_data.policies.policy_file import POLICY, PolicyFile
from astra_data.policies.train import Learn, Training


def with_restarts(
    learn: Learn, training: Training, grounding_file: Path | None
) -> tuple[PolicyFile, dict[str, Any]]:
    """Train until a policy masters its own simulator, `tries` times at most, each from another seed.

    Args:
        learn: trains once.
        training: what it is given.
        grounding_file: of its grounding, which is read again where that is not on the CPU: policies are
            tested there.

    Returns:
        the policy that does, or else the one with the most success there; and its learning curve, with the
        time that all tries took, and with them as "tries": their seeds, what they reached, and their points.
    """
    config = training.config
    if config.tries == 1:
        return learn(training)
    grounding = training.grounding if training.device == "cpu" else grounding_at(grounding_file)
    made: list[tuple[Reached, PolicyFile, dict[str, Any]]] = []
    seeds = [training.seed, *(derive(training.seed, f"try {number}") for number in range(1, config.tries))]
    for number, seed in enumerate(seeds):
        attempt = _attempt(training, seed, number)
        policy, curve = learn(attempt)
        policy.save(attempt.folder / POLICY)
        reached = reached_in_own_world(
            training.task, PolicyFile.load(attempt.folder / POLICY), grounding, training.seed
        )
        made.append((reached, policy, curve))
        if _masters(reached, training):
            break
    _, policy, curve = max(made, key=lambda one: (_masters(one[0], training), one[0].success))
    tries = [
        {"seed": seed, "success": one.success, "episode_steps": one.steps, "points": of_try["points"]}
        for seed, (one, _, of_try) in zip(seeds, made, strict=False)
    ]
    spent = {clock: sum(of_try[clock] for _, _, of_try in made) for clock in CLOCKS if clock in curve}
    for number in range(1, len(made)):
        shutil.rmtree(_folder(training, number))
    return policy, curve | spent | {"tries": tries}


def _attempt(training: Training, seed: int, number: int) -> Training:
    """Return the training of a try; the first is the one that there would be without tries."""
    tries, folder = training.config.tries, _folder(training, number)
    folder.mkdir(exist_ok=True)
    share = part(training.progress, number / tries, (number + 1) / tries)

    def progress(fraction: float, note: str) -> None:
        share(fraction, f"try {number + 1} of {tries}  {note}")

    return replace(training, seed=seed, folder=folder, progress=progress)


def _folder(training: Training, number: int) -> Path:
    return training.folder / f"try_{number}" if number else training.folder


def _masters(reached: Reached, training: Training) -> bool:
    return reached.success >= training.config.least_success
