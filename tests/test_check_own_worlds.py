import json
from pathlib import Path

import check_own_worlds
import pytest
from small_run import COLLECT, GROUND, TASK, TRAIN, short_task

from astra_data.core.progress import silent
from astra_data.grounding.files import grounding_at
from astra_data.stages.collect import collect
from astra_data.stages.ground import ground
from astra_data.stages.pair import PairConfig, pair
from astra_data.stages.train import train
from astra_data.training.own_world import reached_in_own_world
from astra_data.training.policy_file import PolicyFile
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.simulator_episodes import in_simulator
from astra_data.worlds.registry import task_named


def test_policies_are_tested_as_after_training_then_longer_then_without_scatter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = []

    def spied(world: SimulatorEnv, begin: object, steps: int, seed: int) -> object:
        scatters = getattr(world.simulator, "scatter_model", None) is not None
        found = in_simulator(world, begin, steps, seed)  # type: ignore[arg-type]
        tested.append((scatters, steps, world.num_envs))
        return found

    monkeypatch.setattr(check_own_worlds, "in_simulator", spied)
    (tmp_path / "recipe.json").write_text(json.dumps({"task": TASK}))
    scattered = GROUND.model_copy(update={"scatter": True})
    with short_task():
        walks = collect(TASK, COLLECT, seed=0, out=tmp_path / "collect/seed_0", progress=silent)
        pairs = pair(TASK, PairConfig(), dataset=walks, out=tmp_path / "pair/seed_0")
        nas = tmp_path / "ground/nas/seed_0"
        ground(TASK, "nas", scattered, dataset=pairs, out=nas)
        train(TASK, "nas", TRAIN, dataset=pairs, grounding=nas, out=tmp_path / "train/nas/seed_0")
        train(TASK, "direct_transfer", TRAIN, dataset=pairs, out=tmp_path / "train/direct_transfer/seed_0")
        check_own_worlds.main(tmp_path, ["nas", "direct_transfer"], [0])
        task = task_named(TASK)
        policy = PolicyFile.load(tmp_path / "train/nas/seed_0/policy.safetensors")
        own = reached_in_own_world(task, policy, grounding_at(nas / "grounding.safetensors"), 0)
    tests = [(25, True), (38, True), (25, False)]
    assert tested == [
        *[(scatters, steps, 100) for steps, scatters in tests for _ in range(2)],
        *[(False, steps, 100) for steps, _ in tests for _ in range(2)],
    ]
    head, _, *lines = capsys.readouterr().out.splitlines()
    assert head == "| simulator of | who acts | success | in 1.5 times the time | without scatter |"
    told = [line.strip("| ").split(" | ") for line in lines]
    assert [names[:2] for names in told] == [
        [row, acting] for row in ("nas", "direct_transfer") for acting in (row, "follower")
    ]
    assert told[0][2] == f"{own.success:.2f}"
