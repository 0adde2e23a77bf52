from dataclasses import replace

import numpy as np
import pytest
import torch
from grounding_models import HERE, TASK, failure_model, model
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator
from astra_data.grounding.history import HistoryGrounding, ScatterModel, ScatterShape
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.open_loop import _interval, _starts, distances, gap_report, replay_open_loop
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING, Grounding
from astra_data.worlds.plane.navigation import PointMass

STEPS = 60


def episodes(speed: float) -> PairedEpisodes:
    """Return three episodes in a corridor whose target moves at `speed` times the command along x."""
    action = torch.zeros(3, STEPS, 2)
    action[..., 0] = torch.tensor([0.5, 0.8, 1.0])[:, None]
    velocity = torch.zeros(3, STEPS + 1, 2)
    velocity[:, 1:] = speed * action
    start = torch.tensor(TASK.maze.cell_center(1, 1), dtype=torch.float32)
    position = start + (velocity * TASK.timestep_s).cumsum(1)
    state = torch.cat([position, velocity], dim=-1)
    simulator = TASK.simulator(3 * STEPS)
    simulator.reset_to(state[:, :-1].reshape(-1, 4))
    simulated = simulator.step(action.reshape(-1, 2)).reshape(3, STEPS, 4)
    mask = torch.ones(3, STEPS)
    mask[2, 40:] = 0.0
    return toy_episodes(state[:, :-1], action, next_state=state[:, 1:], simulated_next=simulated, mask=mask)


def scattered() -> ScatterModel:
    """Return a scatter of one form, drawn at every step."""
    made = ScatterModel(ScatterShape(8 + 2 + 4 + 16, 4, 1)).requires_grad_(False)
    made.forms.fill_(1.0)
    return made


def untrained() -> HistoryGrounding:
    return HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8, head_sizes=(8,))))


def test_a_perfect_simulator_has_no_gap() -> None:
    report = gap_report(TASK, untrained(), episodes(speed=1.0), seed=0)
    assert report["horizons"] == [1, 10, 50] and report["replays"] == 3 + 3 + 2
    for kind in ("raw", "grounded"):
        for quantity in ("position_m", "velocity_m_s"):
            for figure in ("mean", "low", "high"):
                assert report[kind][quantity][figure] == pytest.approx([0.0, 0.0, 0.0], abs=2e-4)


def test_a_constant_correction_closes_a_constant_gap() -> None:
    grounding = untrained()
    slow = episodes(speed=0.5)
    one = slow.select(torch.tensor([0]))  # the same command throughout, so that one number corrects each step
    error = (one.windows.next_state - one.windows.simulated_next)[0]
    assert error.std(0).max() < 1e-4
    with torch.no_grad():
        list(grounding.model.correction.parameters())[-1].copy_(error.mean(0))
    report = gap_report(TASK, grounding, one, seed=0)
    assert report["raw"]["position_m"]["mean"][-1] > 0.5
    assert report["grounded"]["position_m"]["mean"] == pytest.approx([0.0] * 3, abs=2e-3)
    went_m = [0.5 * 0.5 * TASK.timestep_s * steps for steps in (1, 10, 50)]
    assert report["still"]["position_m"]["mean"] == pytest.approx(went_m, rel=1e-3)
    assert gap_report(TASK, replace(grounding, scatter_model=scattered()), one, seed=0) == report


def test_the_last_real_step_counts_and_the_one_after_does_not() -> None:
    given = episodes(speed=0.9)
    mask = torch.zeros(3, STEPS)
    mask[0, :50], mask[1, :49], mask[2, :10] = 1.0, 1.0, 1.0
    cut = replace(given, windows=replace(given.windows, mask=mask))
    raw = gap_report(TASK, untrained(), cut, seed=0)["raw"]["position_m"]
    # 50 steps fit into the first episode alone: the mean over one replay, which has no interval.
    assert raw["mean"][2] == pytest.approx(0.1 * 0.5 * 50 * TASK.timestep_s, rel=0.01)
    assert raw["low"][2] is raw["high"][2] is None and raw["low"][1] < raw["mean"][1] < raw["high"][1]


@pytest.mark.parametrize("horizon", [1, 10, 50])
def test_replays_start_at_every_step_alike(horizon: int) -> None:
    """Not at a standstill, where episodes begin, more often than on the way."""
    lengths, rng = np.array([60, 9, 100]), np.random.default_rng(0)
    counts = np.zeros((3, 100))
    for _ in range(2000):
        np.add.at(counts, _starts(lengths, horizon, rng), 1)
    for one, possible in zip(counts, lengths - horizon + 1, strict=True):
        assert not one[max(possible, 0) :].any()
        if possible > 0:
            share = -(-possible // 25) / possible
            np.testing.assert_allclose(one[:possible] / 2000, share, atol=5 * np.sqrt(share / 2000))


def test_intervals_are_percentiles_of_means_over_resampled_episodes() -> None:
    torch.manual_seed(0)
    errors, episode = torch.rand(400, dtype=torch.float64), torch.arange(400)
    mean, low, high = _interval(errors, episode, np.random.default_rng(0))
    assert low is not None and high is not None and mean == pytest.approx(float(errors.mean()))
    error = float(errors.std()) / 400**0.5
    assert (mean - low, high - mean) == pytest.approx((1.96 * error, 1.96 * error), rel=0.15)
    # What repeats within an episode tells nothing new.
    again = _interval(errors.repeat(5), episode.repeat(5), np.random.default_rng(0))
    assert again == pytest.approx((mean, low, high))
    absent = _interval(errors, 2 * episode, np.random.default_rng(0))
    assert absent == pytest.approx((mean, low, high))  # each second is absent
    episode = torch.arange(6).repeat_interleave(torch.arange(1, 7))  # longer episodes have more weight
    drawn = np.random.default_rng(1).choice(np.arange(6), (1000, 6))
    of = [errors[:21][episode == number].numpy() for number in range(6)]
    means = [np.concatenate([of[number] for number in row]).mean() for row in drawn]
    expected = (float(errors[:21].mean()), *np.quantile(means, [0.025, 0.975]))
    assert _interval(errors[:21], episode, np.random.default_rng(1)) == pytest.approx(expected)


def test_a_grounding_starts_with_the_history_before_each_replay() -> None:
    """Its correction is the action before the last: open loop it depends on the memory at the start."""
    torch.manual_seed(0)
    grounding, given = untrained(), episodes(speed=0.9)
    torch.nn.init.normal_(list(grounding.model.correction.parameters())[-2], std=0.2)
    action = 2 * torch.rand(3, STEPS, 2) - 1
    previous = torch.cat([torch.zeros(3, 1, 2), action[:, :-1]], dim=1)
    goal = torch.randn(3, 1, 2).expand(3, STEPS, 2)
    changed = replace(given.windows, action=action, previous_action=previous, goal=goal)
    given = replace(given, windows=changed)
    windows, model = given.windows, grounding.model.requires_grad_(False)
    report = gap_report(TASK, grounding, given, seed=0)
    latent, _ = model.encode(windows)
    simulator = TASK.simulator(3 * STEPS)
    simulator.reset_to(windows.state.reshape(-1, 4))
    landed = simulator.step(windows.action.reshape(-1, 2)).reshape(3, STEPS, 4)
    corrected = model.correct(latent, windows.action, landed)
    episode, first = _starts(given.lengths.numpy(), 1, generator(0, "gap starts"))
    assert len(set(first.tolist())) > 3
    expected = distances(TASK, corrected - windows.next_state)[episode, first].mean(0)
    for index, quantity in enumerate(TASK.quantities):
        assert report["grounded"][quantity]["mean"][0] == pytest.approx(float(expected[index]), rel=1e-3)


def test_a_simulator_that_diverges_is_told() -> None:
    """Not left out, as replays that are over are."""

    class Exploding(PointMass):
        def step(self, command: torch.Tensor) -> torch.Tensor:
            return 1e30 * super().step(command)

    task = replace(TASK, make_simulator=lambda count: Exploding(TASK.maze, count, timestep_s=TASK.timestep_s))
    with pytest.raises(BadInputError, match=r"the raw simulator of antmaze-umaze diverges: .* in step 1 of"):
        gap_report(task, NO_GROUNDING, episodes(speed=0.9), seed=0)


REPLAYED = 6


@pytest.mark.parametrize(
    "grounding", [NO_GROUNDING, HistoryGrounding(model(), failure_model(), scatter_model=scattered())]
)
def test_recorded_commands_are_replayed_from_where_episodes_began(grounding: Grounding) -> None:
    """Three episodes that start apart; where the target went afterwards is not to be seen in a replay."""
    torch.manual_seed(1)
    state = HERE + torch.cat([0.2 * torch.rand(3, REPLAYED, 2), torch.zeros(3, REPLAYED, 2)], dim=-1)
    episodes = toy_episodes(state, 2 * torch.rand(3, REPLAYED, 2) - 1, next_state=state)
    found = replay_open_loop(TASK, grounding, episodes, seed=0)
    simulator = grounding.for_replay().simulator(TASK, 3)
    simulator.start(state[:, 0], torch.arange(3), torch.zeros(3, 2))
    assert torch.equal(found[:, 0], state[:, 0]) and found.shape == (3, REPLAYED + 1, 4)
    for step in range(REPLAYED):
        torch.testing.assert_close(found[:, step + 1], simulator.step(episodes.windows.action[:, step]))
