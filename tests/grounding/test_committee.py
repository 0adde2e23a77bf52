import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_cart import TASK, Rail, Reach
from toy_corrections import OFFSETS_M, SCATTER_M, shifted

from astra_data.core.errors import BadInputError
from astra_data.grounding.committee import Committee
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.parameters import IdentifiedParameters
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape


def committee(failures: FailureModel | None = None) -> Committee:
    first, *others = map(shifted, OFFSETS_M)
    return Committee.of(TASK, [HistoryGrounding(first, failures, tuple(others))])


def follow(of: Committee, speed: float = 1.0, steps: int = 12, goal: float = 9.0) -> list[np.ndarray]:  # type: ignore[type-arg]
    action = TASK.limits.normal(torch.full((steps, 2, 1), speed))
    found = of.follow(torch.tensor([[0.0], [5.0]]), torch.full((2, 1), goal), action)
    return [values.numpy() for values in (found.state, found.information, found.reached)]


def test_a_step_teaches_as_much_as_a_normal_outcome_tells_of_its_mean() -> None:
    """With one value, that is ½ log(1 + variance between members / variance of the scatter)."""
    _, information, _ = follow(committee())
    expected = 0.5 * math.log(1 + np.var(OFFSETS_M, ddof=1) / SCATTER_M**2)
    np.testing.assert_allclose(information, expected, rtol=1e-4)


def test_with_several_values_it_is_the_log_determinant() -> None:
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(3, 3))
    of = Committee(TASK, (), (), torch.from_numpy(mixed @ mixed.T))
    predictions = rng.normal(size=(4, 7, 3))
    expected = [
        0.5 * np.log(np.linalg.det(np.eye(3) + np.linalg.solve(mixed @ mixed.T, np.cov(one.T))))
        for one in predictions.transpose(1, 0, 2)
    ]
    np.testing.assert_allclose(of.information(torch.from_numpy(predictions)), expected)


def test_the_members_share_one_path_which_is_that_of_their_mean() -> None:
    state, _, _ = follow(committee())
    way = 0.1 * 1.0 + np.mean(OFFSETS_M)
    np.testing.assert_allclose(state[:, :, 0], np.array([0.0, 5.0]) + way * np.arange(12)[:, None], atol=1e-5)


def test_after_the_goal_nothing_is_reached() -> None:
    state, _, reached = follow(committee(), goal=0.55)
    before = np.cumsum(state[:, 0, 0] >= 0.55) > 0
    np.testing.assert_array_equal(reached[:, 0], ~before)
    assert before.any() and reached[0, 1] == 1.0 and not reached[1:, 1].any()


def test_failures_make_later_steps_less_likely() -> None:
    shape = FailureShape(state_size=1, action_size=1, timestep_s=0.1, members=2)
    failures = FailureModel(shape).eval()
    for member in failures.members:
        torch.nn.init.zeros_(member[-1].weight)  # type: ignore[index]
        torch.nn.init.zeros_(member[-1].bias)  # type: ignore[index]
    _, _, reached = follow(committee(failures=failures))
    np.testing.assert_allclose(reached[:, 0], (1 - 0.5 / 20) ** np.arange(12), rtol=1e-5)


def test_heads_disagree_as_members_do() -> None:
    both = shifted(*OFFSETS_M)
    _, information, _ = follow(Committee.of(TASK, [HistoryGrounding(both)]))
    np.testing.assert_allclose(information, follow(committee())[1], rtol=1e-5)


def test_groundings_of_several_seeds_are_one_committee() -> None:
    made = [HistoryGrounding(shifted(offset)) for offset in OFFSETS_M]
    of = Committee.of(TASK, made)
    np.testing.assert_allclose(follow(of)[1], follow(committee())[1], rtol=1e-5)
    assert of.covariance.item() == pytest.approx(SCATTER_M**2)


def test_rollouts_go_as_in_the_corrected_simulator() -> None:
    """By histories of states, goals and commands; a failure is as probable as the models say on average."""
    torch.manual_seed(0)
    made = shifted(0.0)
    for parameter in made.parameters():
        parameter.normal_(std=0.3)
    foreseeing = [
        FailureModel(FailureShape(state_size=1, action_size=1, timestep_s=0.1, members=1)).eval()
        for _ in range(2)
    ]
    groundings = [HistoryGrounding(made, failures) for failures in foreseeing]
    start, goal, action = torch.tensor([[0.0], [5.0]]), torch.full((2, 1), 9.0), 2 * torch.rand(12, 2, 1) - 1
    found = Committee.of(TASK, groundings).follow(start, goal, action)
    worlds = [one.simulator(TASK, 2) for one in groundings]
    for world in worlds:
        world.start(start, torch.arange(2), goal)
    reached = torch.ones(2)
    for step, command in enumerate(action):
        torch.testing.assert_close(found.state[step], worlds[0].state)
        torch.testing.assert_close(found.reached[step], reached)
        for world in worlds:
            world.step(command)
        risks = [risk for world in worlds if (risk := world.failure_risk()) is not None]
        reached = reached * (1 - (risks[0] + risks[1]) / 2)


def test_the_scatter_and_the_clearance_are_those_of_all_groundings() -> None:
    factors = torch.tensor([[[0.1, 0.0], [0.3, 0.2]], [[0.2, 0.0], [-0.1, 0.4]]])
    made = []
    for factor, clearance_m in zip(factors, (0.3, 0.2), strict=True):
        model = GroundingModel(GroundingShape(2, 1, 1, latent_size=4)).requires_grad_(False)
        model.residual_factor.copy_(factor)
        made.append(HistoryGrounding(model, clearance_m=clearance_m))
    of = Committee.of(TASK, made)
    expected = [[(0.01 + 0.04) / 2, (0.03 - 0.02) / 2], [(0.03 - 0.02) / 2, (0.13 + 0.17) / 2]]
    np.testing.assert_allclose(of.covariance, expected, rtol=1e-6)
    assert of.clearance_m == 0.2


def test_where_touches_are_foreseen_episodes_are_followed_up_to_the_wall() -> None:
    """The recorded clearance is for policies: a failure model tells by itself what comes of touches."""
    ends_there = replace(TASK, objective=replace(TASK.objective, ends_at_walls=True))
    failures = FailureModel(FailureShape(state_size=1, action_size=1, timestep_s=0.1, members=1)).eval()
    for task, model, kept in (
        (TASK, failures, 0.3),
        (ends_there, None, 0.3),
        (ends_there, failures, None),
    ):
        made = [HistoryGrounding(shifted(offset), model, clearance_m=0.3) for offset in OFFSETS_M]
        assert Committee.of(task, made).clearance_m == kept


class Fenced(Rail):
    """A rail with a wall at 1 m."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.clear_m = 0.0
        self.blocked = torch.zeros(num_envs, dtype=torch.bool)

    def keep_clear(self, distance_m: float) -> None:
        self.clear_m = distance_m

    def settle(self, before: torch.Tensor, landed: torch.Tensor) -> torch.Tensor:
        end_m = 1.0 - self.clear_m
        self.blocked = landed[:, 0] > end_m
        self.reset_to(landed.clamp_max(end_m))
        return self.state


class Past(Reach):
    """What is beyond 0.5 m is lost."""

    def missed(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return state[:, 0] > 0.5


@pytest.mark.parametrize(("clearance_m", "end_m"), [(None, 1.0), (0.25, 0.75)])
def test_walls_stop_rollouts_where_corrections_keep_clear(clearance_m: float | None, end_m: float) -> None:
    made = [HistoryGrounding(shifted(offset), clearance_m=clearance_m) for offset in OFFSETS_M]
    for ends in (False, True):
        objective = replace(TASK.objective, ends_at_walls=ends)
        of = Committee.of(replace(TASK, make_simulator=Fenced, objective=objective), made)
        state, _, reached = follow(of, steps=20)
        assert state[-1, 0, 0] == pytest.approx(end_m)
        touched = np.flatnonzero(state[:, 0, 0] >= end_m - 1e-6)[0]
        assert (reached[:touched, 0] == 1.0).all()
        assert (reached[touched:, 0] == (0.0 if ends else 1.0)).all()


def test_what_the_objective_misses_ends_rollouts() -> None:
    made = [HistoryGrounding(shifted(offset)) for offset in OFFSETS_M]
    state, _, reached = follow(Committee.of(replace(TASK, objective=Past(horizon=40)), made))
    np.testing.assert_array_equal(reached[:, 0], state[:, 0, 0] <= 0.5)


def test_one_correction_alone_cannot_disagree() -> None:
    with pytest.raises(BadInputError, match="got a single one: give `\\[ground\\]` members = 4"):
        Committee.of(TASK, [HistoryGrounding(shifted(0.1))])
    with pytest.raises(BadInputError, match="expected groundings by history models"):
        Committee.of(
            TASK, [HistoryGrounding(shifted(0.1)), IdentifiedParameters.__new__(IdentifiedParameters)]
        )


def test_progress_is_told_after_each_step() -> None:
    told = list[float]()
    start, goal = torch.zeros(2, 1), torch.full((2, 1), 9.0)
    committee().follow(start, goal, torch.zeros(4, 2, 1), lambda done, note: told.append(done))
    assert told == [0.25, 0.5, 0.75, 1.0]


def test_what_hardly_scatters_beside_the_rest_is_not_lost_to_rounding() -> None:
    """Two values that scatter together, as a place and the speed that is computed from it."""
    model = GroundingModel(GroundingShape(2, 1, 1, latent_size=4)).requires_grad_(False)
    model.residual_factor.copy_(torch.tensor([[1.0, 0.0], [1.0, 1e-5]]))
    of = Committee.of(TASK, [HistoryGrounding(model, members=(model,))])
    np.testing.assert_allclose(
        of.whitened(torch.tensor([[0.0, 1e-5], [1.0, 1.0]])), [[0, 1], [1, 0]], rtol=1e-4
    )
