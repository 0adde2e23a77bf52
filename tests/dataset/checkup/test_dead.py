import numpy as np
import pytest

from astra_data.dataset.checkup.dead import DeadChannels, longest_rests
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import ACTION, STATE, Array, Column, Episode

COLUMNS = [Column(STATE, size=3, names=("x", "y", "z")), Column(ACTION), Column("next.reward")]


def moving(seed: int, steps: int = 41) -> Array:
    return np.random.default_rng(seed).normal(size=(steps, 3)).astype(np.float32)


def findings(states: list[Array], actions: list[Array] | None = None) -> list[Finding]:
    dead = DeadChannels(COLUMNS)
    for uid, state in enumerate(states):
        action = moving(uid, len(state))[:, 0] if actions is None else actions[uid]
        dead.add(
            Episode(uid, {STATE: state, ACTION: action, "next.reward": np.zeros(len(state), np.float32)})
        )
    return dead.findings("walks")


def held(state: Array, first: int, last: int, index: int = 1) -> Array:
    """Let steps first to last change nothing."""
    out = state.copy()
    out[first : last + 1, index] = out[first, index]
    return out


def test_the_longest_rest_is_counted_in_each_column() -> None:
    changes = np.array([[1, 0, 0], [0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 0, 1]], bool)
    assert longest_rests(changes).tolist() == [2, 5, 2]


def test_a_value_is_constant_only_if_it_is_in_all_episodes() -> None:
    states = [held(moving(uid), 0, 40) for uid in range(3)]
    for state in states:
        state[:, 1] = 2.0
    (found,) = findings(states)
    assert found.what == "constant in all steps: y of observation.state"
    states[2][:, 1] = 2.5  # constant in each episode, but another value
    assert not findings(states)


def test_where_episodes_begin_alike_and_none_goes_on_no_sensor_is_dead() -> None:
    states = [held(moving(0), 0, 40) for _ in range(3)]
    assert not findings([state[:1] for state in states])
    (found,) = findings([states[0][:1], states[1][:2]])  # y in a second step is that of the first
    assert found.what == "constant in all steps: y of observation.state"


def test_a_command_that_was_never_given_is_told() -> None:
    states = [moving(uid) for uid in range(3)]
    (found,) = findings(states, [np.full(41, 0.5, np.float32)] * 3)
    assert (found.severity, found.what) == ("note", "constant in all steps: action")


@pytest.mark.parametrize(("last", "found"), [(20, False), (21, True)])
def test_a_value_is_stuck_above_half_of_an_episode(last: int, found: bool) -> None:
    states = [moving(uid) for uid in range(5)]
    states[3] = held(states[3], 0, last)
    assert [finding.episodes for finding in findings(states)] == [(3,)] * found


@pytest.mark.parametrize(("rests", "found"), [(3, True), (4, False)])
def test_what_often_rests_is_not_stuck(rests: int, found: bool) -> None:
    # Of 40 steps of an episode, 3 are less than a tenth and 4 are not.
    states = [held(moving(uid), 5, 5 + rests) for uid in range(5)]
    states[3] = held(states[3], 0, 30)
    assert bool(findings(states)) is found


@pytest.mark.parametrize(("others", "found"), [(1, True), (2, False)])
def test_most_episodes_must_move(others: int, found: bool) -> None:
    # A puck rests once it was pushed, and before it trembles by the simulator's noise.
    states = [moving(uid) for uid in range(5)]
    states[3] = held(states[3], 0, 30)
    for uid in range(others):
        states[uid] = held(states[uid], 5, 15) if uid else states[uid] * np.array([1, 1e-6, 1], np.float32)
    assert bool(findings(states)) is found


@pytest.mark.parametrize(("far", "found"), [(90.0, True), (110.0, False)])
def test_what_hardly_moves_in_most_episodes_is_not_stuck(far: float, found: bool) -> None:
    # In an episode y spans 1, in one it is also elsewhere.
    states = [moving(uid) for uid in range(5)]
    for uid, state in enumerate(states):
        state[:, 1] = np.linspace(0, 1, 41)
        state[0, 1] += far * (uid == 4)
    states[3] = held(states[3], 0, 30)
    assert bool(findings(states)) is found


@pytest.mark.parametrize(("last", "found"), [(19, True), (20, False)])
def test_a_robot_that_rests_as_a_whole_is_not_stuck(last: int, found: bool) -> None:
    states = [moving(uid) for uid in range(5)]
    states[3] = held(states[3], 0, 30)
    states[3][: last + 1] = states[3][0]
    assert bool(findings(states)) is found


@pytest.mark.parametrize(("steps", "found"), [(9, False), (10, True)])
def test_short_episodes_tell_nothing(steps: int, found: bool) -> None:
    states = [moving(uid) for uid in range(5)]
    states[3] = held(moving(3, steps), 0, steps - 1)
    assert bool(findings(states)) is found
