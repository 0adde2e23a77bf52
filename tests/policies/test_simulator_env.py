from dataclasses import replace
from typing import Any

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.failures import FailureModel, FailureShape, averages_before
from astra_data.grounding.history import GroundedSimulator, HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator, Grounding
from astra_data.methods.iql import experience_of
from astra_data.policies import simulator_env
from astra_data.robots.registry import TASKS
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.navigation import Navigation, PointMass, VariedPlanar
from astra_data.worlds.variation import PlanarVariation

NAVIGATION = Navigation(U_MAZE, horizon=700)
PREDICTED = simulator_env.WorldConfig(reward="predicted")


def world(num_envs: int = 4, **options: Any) -> simulator_env.SimulatorEnv:
    simulator = EpisodeSimulator(PointMass(U_MAZE, num_envs, timestep_s=0.05))
    return simulator_env.SimulatorEnv(NAVIGATION, simulator, simulator_env.WorldConfig(**options))


class Risky(GroundedSimulator):
    """A grounded simulator in which failures come with a probability that is known."""

    risk = 0.05

    def step(self, action: torch.Tensor) -> torch.Tensor:
        landed = super().step(action)
        self.hazard = torch.full((len(landed),), self.risk)
        return landed


def risky(count: int, risk: float, reward: Any = "abstract", **options: Any) -> simulator_env.SimulatorEnv:
    """Return episodes of which every second one reaches the goal in the first step."""
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False)
    simulator = Risky(PointMass(U_MAZE, count, timestep_s=0.05), HistoryGrounding(model))
    simulator.risk = risk
    one = simulator_env.SimulatorEnv(NAVIGATION, simulator, simulator_env.WorldConfig(reward=reward), **options)
    state = torch.tensor([[-4.0, 4.0, 0.0, 0.0], [-3.54, -4.0, 0.0, 0.0]]).repeat(count // 2, 1)
    goal = torch.tensor([[-4.0, -4.0]]).expand(count, 2)
    begun = {"state": state, "goal": goal, "command": torch.zeros(count, 2), "hidden": torch.zeros(count, 8)}
    one.load_state_dict(begun)
    return one


BACK = torch.tensor([[-1.0, 0.0]])


def test_observations_are_scaled_positions_velocity_and_the_way_to_the_goal() -> None:
    state, goal = torch.tensor([[5.0, -10.0, 0.5, -0.5]]), torch.tensor([[-4.0, 4.0]])
    seen = simulator_env.policy_observation(NAVIGATION, state, goal, None)
    assert seen[0].tolist() == pytest.approx([0.5, -1.0, 0.5, -0.5, -0.4, 0.4, -0.9, 1.4])
    with_latent = simulator_env.policy_observation(NAVIGATION, state, goal, torch.tensor([[7.0, 1.0, -5.0, 5.0]]))
    assert with_latent.tolist() == [[3.5, 0.5, -2.5, 2.5, *seen[0].tolist()]]


@pytest.mark.parametrize(("function", "told"), [("observe", "objective.observe"), ("reward", "the reward")])
def test_what_is_not_finite_is_told_with_its_state(function: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, made = world(), getattr(Navigation, function)
    env.reset()

    def sometimes(self: Navigation, *given: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = made(self, *given)
        found[2] = -torch.inf
        return found

    monkeypatch.setattr(Navigation, function, sometimes)
    with pytest.raises(BadInputError) as caught:
        env.step(torch.zeros(4, 2))
    assert world().observation_size == env.observation_size  # of states that no episode begins with
    where = f"state {env.simulator.state[2].tolist()} and the goal {env.goal[2].tolist()}"
    assert str(caught.value) == f"{told}: expected finite numbers, got -inf for the abstract {where}"


def test_it_resumes_where_it_was_from_a_state_that_stays_as_it_was() -> None:
    first, second = (world(change_penalty=1.0) for _ in range(2))
    first.reset()
    first.step(torch.ones(4, 2))
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    kept = {name: values.clone() for name, values in saved.items()}
    assert second.load_state_dict(saved).shape == (4, 8)
    for _ in range(3):
        action = 2 * torch.rand(4, 2) - 1
        a, b = first.step(action), second.step(action)
        assert torch.equal(a.observation, b.observation) and torch.equal(a.reward, b.reward)
    second.reset(torch.tensor([True, False, False, True]))
    assert all(torch.equal(saved[name], values) for name, values in kept.items())


def test_the_price_of_failures_is_four_times_what_they_cost_as_far_as_it_has_grown() -> None:
    plain = risky(2, 0.01).step(BACK.expand(2, 2)).reward
    for scale, price in ((0.0, 0.0), (0.5, 0.2), (1.0, 0.4)):  # a failure costs 10
        priced = risky(2, 0.01, reward="priced")
        priced.penalty_scale = scale
        step = priced.step(BACK.expand(2, 2))
        assert (plain - step.reward).tolist() == pytest.approx([price] * 2, abs=1e-5)
        assert step.success.tolist() == [False, True] and not priced.failed.any()


@pytest.mark.parametrize(("risk", "share"), [(0.05, 0.05), (0.0, 0.0), (1.0, 1.0)])
def test_failures_are_drawn_at_their_probability_and_end_episodes_that_did_not_succeed(
    risk: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Navigation, "missed", Navigation.reached)  # who reaches a goal has not failed, as in targets
    count = 4000
    one = risky(count, risk, draws_failures=True)
    before, goal = one.simulator.state, one.goal
    step = one.step(BACK.expand(count, 2))
    assert step.success[1::2].all() and not step.success[::2].any() and not one.failed[1::2].any()
    assert float(one.failed[::2].float().mean()) == pytest.approx(share, abs=0.015)
    assert torch.equal(step.terminated, step.success | one.failed)
    own = NAVIGATION.reward(before, one.simulator.state, goal, one.failed)
    torch.testing.assert_close(step.reward, own)


def test_a_predicted_reward_is_the_tasks_own_corrected_and_what_the_risk_costs() -> None:
    """By hand: the residual by R_pred, shrunk, the task's own, and hazard times the cost of a failure."""
    torch.manual_seed(1)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False)
    for name, value in {"mean": 0.3, "std": 2.0, "shrinkage": 0.25}.items():
        getattr(model, f"reward_{name}").fill_(value)
    model.failure_cost.fill_(-8.0)
    failures = FailureModel(FailureShape(4, 2, 0.05, members=1, risk_steps=2)).eval()
    grounded = HistoryGrounding(model, failures).corrected(PointMass(U_MAZE, 3, timestep_s=0.05))
    one = simulator_env.SimulatorEnv(NAVIGATION, grounded, PREDICTED)
    one.reset()
    before, latent, action = one.simulator.state, grounded.latent, torch.full((3, 2), 0.2)
    step = one.step(action)
    hazard = grounded.hazard
    assert hazard is not None and (hazard > 0).all()
    normal = model.reward_head(torch.cat([latent, action], dim=-1))[:, -1]
    own = NAVIGATION.reward(before, one.simulator.state, one.goal, torch.zeros(3, dtype=torch.bool))
    torch.testing.assert_close(step.reward, own + 0.25 * (0.3 + 2.0 * normal) - 8.0 * hazard)


def test_predicted_rewards_leave_to_the_task_what_the_simulated_state_shows() -> None:
    torch.manual_seed(0)
    task = TASKS["nao-kick"]
    model = GroundingModel(GroundingShape(8, 3, 2, latent_size=8, ball_index=4, ball_rolls=True, corrects_reward=False))
    one = simulator_env.SimulatorEnv(task.objective, HistoryGrounding(model).corrected(task.simulator(3)), PREDICTED)
    # Balls that roll on in the field, into the goal, and over the side line.
    balls = torch.tensor([[0.0, 0.0, 0.5, 0.0], [1.4, 0.0, 1.0, 0.0], [0.0, 1.9, 0.0, 1.0]])
    state = torch.cat([torch.tensor([[-1.0, 0.0, 0.0, 0.0]]).expand(3, 4), balls], dim=-1)
    goal = torch.tensor([[1.5, 0.0]]).expand(3, 2)
    one.load_state_dict(one.state_dict() | {"state": state, "goal": goal, "hidden": torch.zeros(3, 8)})
    latent = one.simulator.latent
    assert latent is not None
    action = torch.zeros(3, 3)
    step = one.step(action)
    own = task.objective.reward(state, one.simulator.state, goal, torch.tensor([False, False, True]))
    predicted = model.target_reward(latent, action, own).detach()
    assert step.terminated.tolist() == [False, True, True]
    torch.testing.assert_close(step.reward, torch.cat([predicted[:1], own[1:]]))
    assert float(own[1]) > 9.0 and float(own[2]) < -9.0 and float(predicted[0]) != pytest.approx(float(own[0]))


def test_a_change_of_the_command_costs_its_square_whatever_the_penalty_scale() -> None:
    still, penalized = world(2), world(2, change_penalty=0.5, command_limit=0.5)
    penalized.penalty_scale = 0.0
    paid = []
    for command in ([0.0, 0.4], [0.0, 0.4], [3.0, 0.0]):  # the last is shortened to 0.5
        state = penalized.state_dict()
        still.load_state_dict(state)
        reward = penalized.step(torch.tensor([command] * 2)).reward
        paid.append((still.step(torch.tensor([command] * 2).clamp(-0.5, 0.5)).reward - reward).tolist())
    for row, change in zip(paid, (0.16, 0.0, 0.41), strict=True):
        assert row == pytest.approx([0.5 * change] * 2, abs=1e-5)
    penalized.reset(torch.tensor([True, False]))
    still.load_state_dict(penalized.state_dict())
    same = torch.tensor([[0.5, 0.0]] * 2)
    less = still.step(same).reward - penalized.step(same).reward
    assert less.tolist() == pytest.approx([0.125, 0.0], abs=1e-5)


def test_parameters_of_the_episode_are_observed_where_asked_for() -> None:
    variation = PlanarVariation(friction=(0.8, 1.2), heading_bias_deg=(-5.0, 5.0))
    simulator = VariedPlanar(PointMass(U_MAZE, 4, timestep_s=0.05), variation)
    assert simulator_env.SimulatorEnv(NAVIGATION, EpisodeSimulator(simulator)).observation_size == 8
    showing = simulator_env.SimulatorEnv(NAVIGATION, EpisodeSimulator(simulator), shows_parameters=True)
    assert (showing.observation_size, showing.parameter_count) == (8 + 7, 7)
    before = showing.reset()
    torch.testing.assert_close(before[:, 8], (simulator.parameters[:, 0] - 1.0) / 0.2)
    torch.testing.assert_close(before[:, 13], simulator.parameters[:, 5] / 5.0)
    assert not before[:, [9, 10, 11, 12, 14]].any()  # these do not vary
    assert torch.equal(showing.step(torch.ones(4, 2)).observation[:, 8:], before[:, 8:])
    after = showing.reset(torch.tensor([True, False, False, False]))
    assert (after[0, [8, 13]] != before[0, [8, 13]]).all() and torch.equal(after[1:, 8:], before[1:, 8:])
    assert torch.equal(showing.load_state_dict(showing.state_dict()), after)


def test_recorded_starts_hand_over_their_history(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False)
    state, goal = torch.tensor([[4.0, 0.0, 0.1, -0.9]]), torch.tensor([[-4.2, -4.1]])
    starts = simulator_env.DataStarts(state, goal, torch.tensor([[0.5, -1.0]]), hidden=torch.randn(1, 8))
    grounded = HistoryGrounding(model).corrected(PointMass(U_MAZE, 3, timestep_s=0.05))
    world = simulator_env.WorldConfig(data_start_share=1.0, change_penalty=0.1)
    one = simulator_env.SimulatorEnv(NAVIGATION, grounded, world, starts=starts)
    monkeypatch.delattr(Navigation, "draw_starts")  # there are none to draw
    one.reset()
    assert torch.equal(one.state_dict()["command"], starts.previous_action.expand(3, 2))
    assert starts.hidden is not None
    expected = model.encoder.step(model.encoder_input(state, goal, starts.previous_action), starts.hidden)
    torch.testing.assert_close(grounded.hidden, expected.expand(3, 8))
    assert torch.equal(one.goal, goal.expand(3, 2)) and torch.equal(grounded.goal, one.goal)


TASK = TASKS["antmaze-umaze"]
FROM_DATA = simulator_env.WorldConfig(data_start_share=1.0)


@pytest.fixture
def episodes() -> PairedEpisodes:
    """Return two episodes of 400 and 300 steps around the middle of a corridor."""
    torch.manual_seed(0)
    here = torch.tensor(TASK.maze.cell_center(1, 2), dtype=torch.float32)
    state = torch.cat([here + 0.5 * torch.rand(2, 401, 2), torch.randn(2, 401, 2)], dim=-1)
    mask = torch.ones(2, 400)
    mask[1, 300:] = 0.0
    return toy_episodes(
        state[:, :-1], torch.rand(2, 400, 2) * 2 - 1, next_state=state[:, 1:], goal=torch.randn(2, 400, 2), mask=mask
    )


@pytest.fixture
def grounding() -> HistoryGrounding:
    torch.manual_seed(0)
    return HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)))


def built(world: simulator_env.WorldConfig, grounding: Grounding, **given: Any) -> simulator_env.SimulatorEnv:
    options: dict[str, Any] = {"num_envs": 4, "device": "cpu"} | given
    return simulator_env.training_env(TASK, simulator_env.Simulation(world), grounding, **options)


def test_without_settings_it_is_the_plain_simulator(episodes: PairedEpisodes, grounding: HistoryGrounding) -> None:
    kinds: dict[type[EpisodeSimulator], Grounding] = {EpisodeSimulator: NO_GROUNDING, GroundedSimulator: grounding}
    for kind, used in kinds.items():
        assert simulator_env.data_starts(TASK, simulator_env.WorldConfig(), episodes, used) is None
        world = built(simulator_env.WorldConfig(), used)
        assert type(world.simulator) is kind and type(world.simulator.simulator) is PointMass
        assert (world.world, world.num_envs) == (simulator_env.WorldConfig(), 4)
        drawn = torch.get_rng_state()
        world.step(torch.zeros(4, 2))
        assert torch.equal(torch.get_rng_state(), drawn)


def test_what_observe_makes_of_padding_is_not_seen(episodes: PairedEpisodes, monkeypatch: pytest.MonkeyPatch) -> None:
    of, mask = episodes.windows, episodes.windows.mask.unsqueeze(-1)
    state = (of.state * mask).index_fill(1, torch.tensor([0]), 0.0)  # and of a real step there is none
    given = replace(episodes, windows=replace(of, state=state, next_state=of.next_state * mask))
    monkeypatch.setattr(Navigation, "observe", lambda self, state, goal: state / state.norm(dim=-1, keepdim=True))
    learned = experience_of(TASK, given)
    assert learned.next_observation.isfinite().all()
    for seen in (simulator_env.recorded_steps(TASK, given, NO_GROUNDING).observation, learned.observation):
        assert seen[:, 1:].isfinite().all() and seen[:, 0, :4].isnan().all()


@pytest.mark.parametrize(("reward", "prices"), [("abstract", False), ("predicted", True), ("priced", True)])
def test_a_failure_model_is_used_and_starts_know_what_it_remembers_where_failures_have_a_price(
    reward: Any, prices: bool, episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    foresees = replace(grounding, failures=failures)
    config = simulator_env.WorldConfig(reward=reward, data_start_share=0.5)
    starts = simulator_env.data_starts(TASK, config, episodes, foresees)
    assert starts is not None and starts.hidden is not None
    world: Any = built(config, foresees, starts=starts).simulator
    assert world.failures is (failures if prices else None)
    averages = averages_before(TASK, foresees, failures, episodes)
    assert float(averages[:, 50].abs().sum()) > 0
    known = averages[episodes.windows.mask.bool()] if prices else averages[0, :, :0]
    torch.testing.assert_close(starts.hidden[:, 8:], known if prices else starts.hidden[:, :0])
    hidden = grounding.hidden_before(episodes.windows)[episodes.windows.mask.bool()]
    assert torch.equal(starts.hidden[:, :8], hidden)


def test_recorded_starts_come_with_the_history_before_them(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    starts = simulator_env.data_starts(TASK, FROM_DATA, episodes, grounding)
    assert starts is not None and starts.hidden is not None and len(starts.state) == len(starts.hidden) == 700
    windows, model = episodes.windows, grounding.model
    inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
    hidden, shown = torch.zeros(1, 8), simulator_env.recorded_steps(TASK, episodes, grounding)
    assert torch.equal(shown.lengths, episodes.lengths) and torch.equal(shown.action, windows.action)
    assert torch.equal(shown.previous_action, windows.previous_action)
    world = built(FROM_DATA, grounding, starts=starts)
    for step in range(5):
        row = 400 + step  # of the second episode
        torch.testing.assert_close(starts.hidden[row : row + 1], hidden)
        assert torch.equal(starts.state[row], windows.state[1, step])
        assert torch.equal(starts.previous_action[row], windows.previous_action[1, step])
        world.start_from(
            windows.state[1:, step], windows.goal[1:, step], torch.arange(1), hidden, inputs[1:, step, -2:]
        )
        torch.testing.assert_close(world.reset(torch.zeros(4, dtype=torch.bool))[:1], shown.observation[1:, step])
        hidden = model.encoder.step(inputs[1:, step], hidden)


SHORT, LONG = 0.8, 1.4
"""Lengths of commands, kept through an episode."""


def recorded(failing: dict[float, int], lengths: tuple[float, ...] = (SHORT, LONG)) -> PairedEpisodes:
    """Return 40 episodes of 30 steps for each length of commands, of which so many fail."""
    length = torch.tensor(lengths).repeat_interleave(40)[:, None].expand(-1, 30)
    angle = torch.linspace(0.0, 3.0, 30).expand_as(length)
    action = torch.stack([length * angle.cos(), length * angle.sin()], dim=-1)
    fails = torch.cat([torch.arange(40) < failing.get(one, 0) for one in lengths])
    state = torch.tensor([-4.0, 4.0, 0.0, 0.0]).expand(len(fails), 30, 4)
    made = toy_episodes(state, action, next_state=state, goal=torch.zeros(len(fails), 30, 2))
    soon = (fails[:, None] & (torch.arange(30) >= 10)).float()
    return replace(made, windows=replace(made.windows, fails_soon=soon))


@pytest.mark.parametrize(
    ("failing", "lengths", "expected"),
    [
        ({}, (SHORT, LONG), NO_LIMIT),
        ({LONG: 12}, (SHORT, LONG), 1.0),
        ({SHORT: 4, LONG: 6}, (SHORT, LONG), 1.0),
        ({SHORT: 4, LONG: 5}, (SHORT, LONG), NO_LIMIT),
        ({SHORT: 12}, (SHORT, LONG), NO_LIMIT),
        ({SHORT: 12}, (SHORT,), NO_LIMIT),
        ({LONG: 1}, (LONG,), 1.0),
    ],
)
def test_it_is_one_where_failures_are_half_as_frequent_again_above(
    failing: dict[float, int], lengths: tuple[float, ...], expected: float
) -> None:
    assert simulator_env.command_limit(TASK, recorded(failing, lengths)) == expected


def test_commands_of_the_last_second_count() -> None:
    """Commands that were long until 20 steps before a failure are no part of it."""
    whole = recorded({LONG: 12})
    windows, late = whole.windows, torch.arange(30)[:, None] >= 10
    gone = replace(windows, action=torch.where(late, windows.action * 0.5 / LONG, windows.action))
    assert simulator_env.command_limit(TASK, replace(whole, windows=gone)) == NO_LIMIT
