"""Rows that repeat, and actions beside those of other rows."""

from collections.abc import Callable

import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.checkup.rows import Repeats, Shift
from astra_data.dataset.columns import ACTION, STATE, Episode


def found(look: Callable[[], Repeats | Shift], state: Floats, action: Floats | None = None) -> list[Finding]:
    part = look()
    halves = (slice(0, len(state) // 2), slice(len(state) // 2, None))
    for uid, half in enumerate(halves):
        columns = {STATE: state[half].astype(np.float32)}
        part.add(
            Episode(
                uid, columns | ({ACTION: action[half].astype(np.float32)} if action is not None else {}), {}
            )
        )
    return part.findings()


def walk(actions: Floats, delay: int = 0) -> Floats:
    """Return states (T, 2) that each action of `delay` rows before moves."""
    moves = np.roll(actions, delay, axis=0)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(0.1 * moves, axis=0)[:-1]])


ACTIONS = np.random.default_rng(0).normal(size=(400, 2))


def test_rows_that_were_written_twice_are_found() -> None:
    [finding] = found(Repeats, np.repeat(walk(ACTIONS), 2, axis=0))
    assert finding.severity == "warning"
    assert finding.what.startswith("396 of 798 steps repeat the state of the row before to the bit")


@pytest.mark.parametrize(
    "state",
    [
        walk(ACTIONS),
        walk(np.where(np.arange(400)[:, None] % 100 < 50, 0, ACTIONS)),  # rests
        np.zeros((400, 2)),
        np.where(np.arange(400)[:, None] == 7, np.roll(walk(ACTIONS), 1, axis=0), walk(ACTIONS)),  # one
    ],
)
def test_a_robot_that_rests_repeats_no_rows(state: Floats) -> None:
    assert found(Repeats, state) == []


@pytest.mark.parametrize("off", [-3, -1, 1, 2])
def test_actions_of_other_rows_are_found(off: int) -> None:
    [finding] = found(Shift, walk(ACTIONS), np.roll(ACTIONS, off, axis=0))
    rows = f"{abs(off)} row{'s' if abs(off) > 1 else ''}"
    where = "later" if off > 0 else "earlier"
    assert finding.what.startswith(f"steps follow from the action {rows} {where}, which explains 100%")
    assert finding.severity == ("warning" if off > 0 else "note")


def feedback() -> tuple[Floats, Floats]:
    """Return states and actions of a robot that is steered back to 0, with noise in both."""
    rng = np.random.default_rng(1)
    states, actions = np.zeros((400, 2)), np.zeros((400, 2))
    for t in range(400):
        actions[t] = -states[t] + 0.1 * rng.normal(size=2)
        if t < 399:
            states[t + 1] = states[t] + 0.2 * actions[t] + 0.02 * rng.normal(size=2)
    return states, actions


@pytest.mark.parametrize(
    ("state", "action"),
    [
        (walk(ACTIONS), ACTIONS),
        (walk(ACTIONS) + 0.01 * np.random.default_rng(2).normal(size=(400, 2)), ACTIONS),
        (np.zeros((400, 2)), ACTIONS),
        (walk(np.repeat(ACTIONS[:40], 10, axis=0)), np.repeat(ACTIONS[:40], 10, axis=0)),
        (np.random.default_rng(3).normal(size=(400, 2)), ACTIONS),
        (walk(ACTIONS)[:30], np.roll(ACTIONS, 1, axis=0)[:30]),  # too few
        feedback(),
    ],
)
def test_actions_of_their_own_rows_are_not(state: Floats, action: Floats) -> None:
    assert found(Shift, state, action) == []
