from pathlib import Path
from typing import Any

import pytest
from rail_run import make_rail_run
from small_cart import TASK

from astra_data.grounding.files import load_grounding
from astra_data.grounding.simulator import FittedGrounding
from astra_data.policies import episodes as judging
from astra_data.policies.running_policy import PolicyFile, RunningPolicy, running
from astra_data.policies.simulator_env import SimulatorEnv

pytestmark = pytest.mark.usefixtures("quick_failures")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rail_run(tmp_path_factory.mktemp("judging"), seeds="[0]", methods='["nas"]')


@pytest.fixture
def judge(folder: Path) -> FittedGrounding:
    return load_grounding(folder / "ground/nas/seed_0/grounding.safetensors")


@pytest.fixture
def policy(folder: Path, judge: FittedGrounding) -> RunningPolicy:
    return running(TASK, PolicyFile.load(folder / "train/nas/seed_0/policy.safetensors"), judge)


def test_failures_are_drawn_in_the_whole_simulator_of_the_grounding(
    judge: FittedGrounding, policy: RunningPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[tuple[SimulatorEnv, int, int]]()

    def seen(world: SimulatorEnv, begin: object, horizon: int, seed: int) -> object:
        made.append((world, horizon, seed))
        raise StopIteration

    monkeypatch.setattr(judging, "in_simulator", seen)
    with pytest.raises(StopIteration):
        judging.judged_success(TASK, judge, policy, 5, 7)
    world, horizon, seed = made[0]
    assert (world.num_envs, horizon, seed) == (5, TASK.objective.horizon, 7)
    used: Any = world.simulator
    whole: Any = judge
    assert world.draws_failures and whole.failures is not None and whole.scatter_model is not None
    assert (used.failures, used.scatter_model) == (whole.failures, whole.scatter_model)
