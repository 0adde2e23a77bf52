from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rail_run import make_rail_run
from small_cart import TASK
from torch import Tensor

from astra_data.grounding.failures import fit_failures, tells_failures
from astra_data.grounding.files import load_grounding
from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.failure import FailureModel
from astra_data.learning.networks.scatter import ScatterModel, ScatterShape
from astra_data.training import judging
from astra_data.training.judging import Judge
from astra_data.training.policy_file import PolicyFile, running
from astra_data.training.running_policy import RunningPolicy
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.worlds.protocols import PlacedSimulator

pytestmark = pytest.mark.usefixtures("quick_failures")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rail_run(tmp_path_factory.mktemp("judging"), seeds="[0]", methods='["nas"]')


@pytest.fixture
def judge(folder: Path) -> Judge:
    made = load_grounding(folder / "ground/nas/seed_0/grounding.safetensors")
    return Judge.of(TASK, made, PairedEpisodes.load(folder / "pair/seed_0"))


@pytest.fixture
def policy(folder: Path, judge: Judge) -> RunningPolicy:
    return running(TASK, PolicyFile.load(folder / "train/nas/seed_0/policy.safetensors"), judge.grounding)


def test_members_do_not_judge(folder: Path, judge: Judge) -> None:
    made = judge.grounding
    assert isinstance(made, HistoryGrounding)
    with_members = replace(made, members=(made.model, made.model))
    again = Judge.of(TASK, with_members, PairedEpisodes.load(folder / "pair/seed_0"))
    assert isinstance(again.grounding, HistoryGrounding)
    assert again.grounding.members == ()


@pytest.mark.parametrize("foresees", [True, False])
def test_a_judge_ends_episodes_by_its_failure_model_or_else_scatters_states(
    foresees: bool,
    judge: Judge,
    policy: RunningPolicy,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []
    whole: Any = judge.grounding
    judge = replace(judge, grounding=whole.reduced(members=True, failures=foresees))

    def seen(world: SimulatorEnv, begin: object, horizon: int, seed: int) -> object:
        made.append((world, horizon, seed))
        raise StopIteration

    monkeypatch.setattr(judging, "in_simulator", seen)
    with pytest.raises(StopIteration):
        judge.success(policy, 5, 7)
    world, horizon, seed = made[0]
    assert horizon == TASK.objective.horizon and seed == 7 and world.num_envs == 5
    grounding: Any = judge.grounding
    assert isinstance(grounding, HistoryGrounding) and (grounding.failures is not None) == foresees
    assert world.topple == foresees  # episodes end where the failure model says
    assert grounding.model.residual_factor.abs().sum() > 0
    simulator: Any = world.simulator
    if foresees:
        assert simulator.scatter is None
    else:
        assert torch.equal(simulator.scatter, grounding.model.residual_factor)


def test_a_judge_that_scatters_by_the_moment_adds_no_other_scatter(judge: Judge) -> None:
    whole: Any = judge.grounding
    state_size, inputs = whole.model.shape.state_size, whole.model.corrections[0][0].in_features
    scatters = ScatterModel(ScatterShape(inputs, state_size, 1)).requires_grad_(False)
    for known in (None, scatters):
        made = replace(judge, grounding=replace(whole, failures=None, scatter_model=known))
        simulator: Any = made.simulator(2).simulator
        assert simulator.scatter_model is known
        assert (simulator.scatter is None) == (known is not None)


@pytest.mark.parametrize("foresees", [True, False])
@pytest.mark.parametrize("touches_fail", [True, False])
def test_where_a_failure_model_tells_touches_a_judge_keeps_no_distance_from_walls(
    foresees: bool, touches_fail: bool, judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, kept = HistoryGrounding.corrected, list[float | None]()

    def noted(
        grounding: HistoryGrounding, simulator: PlacedSimulator, scatter: Tensor | None
    ) -> GroundedSimulator:
        kept.append(grounding.clearance_m)
        return made(grounding, simulator, scatter)

    monkeypatch.setattr(HistoryGrounding, "corrected", noted)
    whole: Any = judge.grounding
    grounding = replace(whole.reduced(members=True, failures=foresees), clearance_m=0.3)
    task = replace(TASK, objective=replace(TASK.objective, ends_at_walls=touches_fail))
    replace(judge, task=task, grounding=grounding).simulator(2)
    assert kept == [None if foresees and touches_fail else 0.3]


def test_a_judge_without_a_failure_model_gets_one_where_its_episodes_fail(
    folder: Path, judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = PairedEpisodes.load(folder / "pair/seed_0")
    known: Any = judge.grounding
    lacking = known.reduced(members=True, failures=False)

    def failures_of(grounding: HistoryGrounding, of: PairedEpisodes, members: int) -> FailureModel | None:
        made: Any = Judge.of(TASK, grounding, of, members, 4).grounding
        assert isinstance(made, HistoryGrounding) and made.model is grounding.model
        return made.failures

    assert tells_failures(TASK, episodes) and known.failures is not None
    fitted = failures_of(lacking, episodes, 3)
    assert fitted is not None and len(fitted.members) == 3
    expected = fit_failures(TASK, lacking, episodes, 3, 0, 4)
    assert fitted.shape.risk_steps == 4
    assert all(torch.equal(one, expected.state_dict()[key]) for key, one in fitted.state_dict().items())
    assert failures_of(known, episodes, 3) is known.failures
    assert failures_of(lacking, episodes, 0) is None
    never = replace(episodes.windows, fails_soon=torch.zeros_like(episodes.windows.fails_soon))
    assert failures_of(lacking, replace(episodes, windows=never), 3) is None
    # Of short episodes all steps are within 20 of a failure, but not within 4.
    mask = episodes.windows.mask * (torch.arange(episodes.windows.mask.shape[1]) < 10)
    short = replace(episodes.windows, mask=mask, fails_soon=mask)
    assert failures_of(lacking, replace(episodes, windows=short), 3) is not None
    monkeypatch.setattr(type(TASK.objective), "missed", lambda _, state, goal: state[:, 0] == state[:, 0])
    assert failures_of(lacking, episodes, 3) is None  # the simulator sees these failures itself


def test_success_is_the_share_of_the_episodes(
    judge: Judge, policy: RunningPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy that drives on reaches every goal within the horizon, where nothing fails."""
    monkeypatch.setattr(judging, "HistoryGrounding", int)
    for speed, success in ((0.5, 1.0), (-0.6, 0.0)):

        def act(_: object, state: object, goal: torch.Tensor, speed: float = speed) -> torch.Tensor:
            return goal * 0 + speed

        monkeypatch.setattr(RunningPolicy, "act_in_simulator", act)
        assert judge.success(policy, 5, 0) == success
