"""Trainings that are done again where a policy did not master its own simulator."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from constant_policy import Constant
from small_cart import TASK
from toy_episodes import toy_episodes

from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import derive
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.running_policy import KINDS, PolicyFile, UserPolicy
from astra_data.policies.train import PpoTrainConfig, Training, UserLearner, with_restarts

SEEDS = [7, derive(7, "try 1"), derive(7, "try 2")]


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "constant", Constant)


def restarted(
    folder: Path, commands: Iterable[float], progress: Progress = silent, clocks: bool = False, **settings: Any
) -> tuple[float, dict[str, Any], list[int]]:
    """Train policies that give these commands, one a try; return what is kept, the curve and the seeds."""
    rest, seeds, one = iter(commands), [], torch.zeros(1, 3, 1)

    def learn(env: Any, given: Training) -> Constant:
        seeds.append(given.seed)
        given.progress(1.0, "")
        assert given.folder.is_dir()
        policy = Constant(next(rest))
        observation, _ = env.reset()
        env.step(policy.act(observation))
        return policy

    training = Training(
        task=TASK,
        config=PpoTrainConfig(num_envs=4, total_steps=4, data_start_share=0.0, **settings),
        settings=None,
        episodes=toy_episodes(one, one, next_state=one),
        grounding=NO_GROUNDING,
        initial=None,
        seed=7,
        device="cpu",
        folder=folder,
        progress=progress,
    )
    learner = UserLearner(learn=learn, policy=Constant)

    def timed(given: Training) -> tuple[PolicyFile, dict[str, Any]]:
        kept, curve = learner(given)
        return kept, curve | ({"wall_seconds": 2.0 * len(seeds), "cpu_seconds": len(seeds)} if clocks else {})

    kept, curve = with_restarts(timed, training, None)
    assert isinstance(kept, PolicyFile) and isinstance(kept.policy, UserPolicy)
    return kept.policy.acting.command, curve, seeds  # type: ignore[attr-defined]


def test_a_policy_that_masters_its_simulator_is_kept(tmp_path: Path) -> None:
    command, curve, seeds = restarted(tmp_path, [1.0], tries=3)
    assert (command, seeds) == (1.0, SEEDS[:1])
    assert [(one["seed"], one["success"]) for one in curve["tries"]] == [(7, 1.0)]
    assert curve["points"] == curve["tries"][0]["points"]


def test_it_is_trained_again_until_it_does(tmp_path: Path) -> None:
    shares, notes = list[float](), list[str]()

    def progress(share: float, note: str) -> None:
        shares.append(share)
        notes.append(note.partition("  ")[0])

    command, curve, seeds = restarted(tmp_path, [-1.0, 0.9, 1.0], progress, tries=3)
    assert (command, seeds) == (0.9, SEEDS[:2]) and [one["success"] for one in curve["tries"]] == [0.0, 1.0]
    # Forward at 3.75 m/s goals from 1 to 2 m are reached in 3 to 6 steps; backward none in all 40.
    assert curve["tries"][0]["episode_steps"] == 40 and 3 < curve["tries"][1]["episode_steps"] < 6
    assert shares == sorted(shares) and max(shares) == pytest.approx(2 / 3)
    assert sorted(set(notes)) == ["try 1 of 3", "try 2 of 3"] and not (tmp_path / "try_1").exists()


def test_of_those_that_do_not_the_best_is_kept(tmp_path: Path) -> None:
    # At 0.4 m/s, -0.44 of the range, goals up to 1.6 m are in reach within the 4 s of an episode.
    command, curve, seeds = restarted(tmp_path, [-1.0, -0.44, -0.9], tries=3)
    assert (command, seeds) == (-0.44, SEEDS) and 0.4 < curve["tries"][1]["success"] < 0.8


def test_all_tries_cost_time(tmp_path: Path) -> None:
    command, curve, _ = restarted(tmp_path, [-0.44, -1.0, -0.9], tries=3, clocks=True)
    assert command == -0.44 and (curve["wall_seconds"], curve["cpu_seconds"]) == (2 + 4 + 6, 1 + 2 + 3)
    assert "wall_seconds" not in restarted(tmp_path, [-1.0, 1.0], tries=2)[1]
