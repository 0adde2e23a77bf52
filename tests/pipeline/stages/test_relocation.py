from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from astra_data.dataset import columns as keys
from astra_data.pipeline.stages.augment import Relocation, outcomes, positions
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
KICKING = TASKS["nao-kick"]
AIM = np.array(TASK.maze.cell_center(*TASK.maze.goal), np.float32)


def relocation(**changes: Any) -> Relocation:
    settings: dict[str, Any] = {"rotations": "quarter", "translations": True, "margin_m": 1.3, "min_steps": 5}
    return Relocation(TASK, **settings | changes)


def straight(start: tuple[float, float], end: tuple[float, float], steps: int) -> keys.Episode:
    """Return an episode that slides from `start` to `end`, commanded along (1, 1)."""
    path = np.zeros((steps + 1, 29), np.float32)
    path[:, :2] = np.linspace(start, end, steps + 1)
    path[:, 3] = 1
    columns = {keys.STATE: path[:-1].copy(), keys.NEXT_STATE: path[1:].copy()}
    return keys.Episode(0, {**columns, keys.ACTION: np.full((steps, 2), 0.9, np.float32)})


def test_only_what_keeps_its_distance_may_move() -> None:
    # The upper corridor is 4 m wide, its middle at y = 4 m; the path sags toward the wall and comes back.
    path = straight((-4.0, 4.0), (4.0, 4.0), 100)
    for name in (keys.STATE, keys.NEXT_STATE):
        x = path.columns[name][:, 0]
        path.columns[name][:, 1] -= np.where(np.abs(x) < 1.0, 1.5, 0.0)
    (first, second) = relocation().stretches(path)
    assert (first[0], second[1]) == (0, 100) and abs(first[1] - 37) <= 1 and abs(second[0] - 63) <= 1
    assert relocation(min_steps=40).stretches(path) == [] and relocation(margin_m=0.3).stretches(path) == [(0, 100)]
    assert relocation(min_steps=100, margin_m=0.3).stretches(path) == [(0, 100)]
    # Drawn in proportion to their lengths.
    short = keys.Episode(0, {name: values[25:] for name, values in path.columns.items()})
    still, rng = relocation(rotations="none", translations=False), np.random.default_rng(0)
    firsts = [steps.start for _ in range(4) for _, steps in still.placements(short, rng)]
    assert len(firsts) == 400 and firsts.count(0) / 400 == pytest.approx(12 / 49, abs=0.07)


def draws(count: int, episode: keys.Episode, **changes: Any) -> list[Any]:
    rng = np.random.default_rng(0)
    drawn = [next(relocation(**changes).placements(episode, rng), None) for _ in range(count)]
    assert None not in drawn
    return drawn


def moved(change: Any, episode: keys.Episode) -> keys.Array:
    return np.asarray(change.positions(positions(TASK, episode.columns[keys.STATE]).astype(np.float64)))


def test_quarter_turns_go_everywhere_that_is_free() -> None:
    path = straight((-4.5, 4.0), (-3.5, 4.0), 20)
    drawn: keys.Array = np.array([moved(change, path) for change, _ in draws(80, path)])
    ends = drawn.astype(np.float32)  # as they are stored
    assert (TASK.maze.clearance(ends.astype(np.float64)) > 1.3).all()
    bearing = np.arctan2(*(ends[:, -1] - ends[:, 0]).T[::-1])
    turns = np.round(bearing / (np.pi / 2))
    np.testing.assert_allclose(bearing, turns * np.pi / 2, atol=1e-6)
    assert set(turns % 4) == {0, 1, 2, 3}
    # In all three corridors.
    assert ends[:, 0, 1].max() > 3 and ends[:, 0, 1].min() < -3 and (np.abs(ends[:, 0, 1]) < 2).any()


def test_what_fits_nowhere_is_given_up() -> None:
    # Nine meters fit into a corridor, but not at right angles to it where they start.
    path = straight((-4.5, 4.0), (4.5, 4.0), 60)
    change, _ = next(relocation(translations=False).placements(path, np.random.default_rng(0)))
    assert change.rotation_rad == 0.0
    long = straight((-4.5, 4.0), (4.5, 4.0), 60)
    long.columns[keys.ACTION][:] = 2.0
    assert list(relocation().placements(long, np.random.default_rng(0))) == []


@pytest.mark.parametrize(("toppled_at", "length", "success"), [(None, 16, True), (9, 10, False), (15, 16, True)])
def test_an_episode_ends_at_the_goal_or_where_it_topples(toppled_at: int | None, length: int, success: bool) -> None:
    # 0.1 m per step along the lower corridor; within 0.45 m of the goal from step 15 on.
    path = straight((AIM[0] + 2.0, AIM[1]), (AIM[0] - 1.0, AIM[1]), 30)
    before, after = (TASK.abstraction(path.columns[name]) for name in (keys.STATE, keys.NEXT_STATE))
    toppled = np.arange(30) == toppled_at
    judged = outcomes(TASK.objective, before, after, AIM, toppled)
    assert {len(values) for values in judged.values()} == {length}
    assert judged["next.success"].tolist() == [False] * (length - 1) + [success]
    assert judged["next.terminated"].tolist() == judged["next.done"].tolist() and not judged["next.truncated"].any()
    # The last step earns +10 or -10; all of them 0.1 m of progress.
    assert judged["next.reward"][-1] == pytest.approx(10.1 if success else -9.9, abs=0.02)
    assert judged["next.reward"][:-1].mean() == pytest.approx(0.1, abs=0.02)


def kick(steps: int, ball_m: float, *, ends: bool = False) -> keys.Episode:
    """Return an episode of a robot that stands at the origin, and whose ball rolls on by `ball_m` a step."""
    state = np.zeros((steps + 1, KICKING.state.size), np.float32)
    state[:, 2] = 1.0
    state[:, -5] = 0.2 + ball_m * np.arange(steps + 1)
    state[1:, -3] = ball_m / KICKING.timestep_s
    last = np.arange(steps) == steps - 1
    columns = {
        keys.STATE: state[:-1].copy(),
        keys.NEXT_STATE: state[1:].copy(),
        keys.ACTION: np.tile(np.array([0.3, 0.0, 1.0], np.float32), (steps, 1)),
        keys.GOAL: np.tile(np.array([1.5, 0.0], np.float32), (steps, 1)),
        keys.TERMINATED: last & ends,
        keys.SUCCESS: np.zeros(steps, dtype=bool),
    }
    return keys.Episode(7, columns, {})


def kicks(count: int, episode: keys.Episode) -> list[dict[str, keys.Array]]:
    place, rng = replace(relocation(margin_m=0.3, rotations="any"), task=KICKING), np.random.default_rng(0)
    moving = [KICKING.state, replace(KICKING.state, name=keys.NEXT_STATE), KICKING.action]
    copied = [place.copied(episode, moving, rng) for _ in range(count)]
    return [copy[0] for copy in copied if copy is not None]


def test_a_ball_moves_with_its_robot() -> None:
    made = kicks(100, kick(12, 0.1))
    assert len(made) == 100
    turns = set()
    for columns in made:
        start, end = (KICKING.abstraction(columns[name]) for name in (keys.STATE, keys.NEXT_STATE))
        apart, heading = start[:, 4:6] - start[:, :2], columns[keys.STATE][:, 2:4]
        distance = 0.2 + 0.1 * np.arange(len(start))
        np.testing.assert_allclose(apart, distance[:, None] * heading, atol=1e-5)
        np.testing.assert_allclose(columns[keys.ACTION][:, :2], 0.3 * heading, atol=1e-6)
        assert (columns[keys.ACTION][:, 2] == 1.0).all()
        np.testing.assert_allclose(end[1:, 6:], 0.1 / KICKING.timestep_s * heading[1:], atol=1e-5)
        turns.add(round(float(np.arctan2(heading[0, 1], heading[0, 0])), 2))
    assert len(turns) > 80


def test_a_ball_begins_on_the_field_and_ends_the_copy_where_it_leaves_it() -> None:
    ends = {"goal": 0, "out": 0, "field": 0}
    for columns in kicks(300, kick(12, 0.1)):
        x, y = KICKING.abstraction(columns[keys.STATE])[0, 4:6]
        assert -2.0 <= x < 1.5 and abs(y) <= 2.0
        end = KICKING.abstraction(columns[keys.NEXT_STATE])
        x, y = end[-1, 4:6]
        is_out = x >= 1.5 or x < -2 or abs(y) > 2
        how = "goal" if x >= 1.5 and abs(y) <= 0.75 else "out" if is_out else "field"
        ends[how] += 1
        before = [False] * (len(end) - 1)
        assert columns[keys.SUCCESS].tolist() == [*before, how == "goal"]
        assert columns[keys.TERMINATED].tolist() == [*before, how != "field"]
        assert columns[keys.TRUNCATED].tolist() == [*before, how == "field"]
        assert len(end) == 12 or how != "field"
        # All but the end is paid by the meters that ball and robot come closer, less than 0.15 a step.
        assert columns[keys.REWARD][-1] == pytest.approx({"goal": 10, "out": -10, "field": 0}[how], abs=0.2)
    assert min(ends.values()) > 10


def test_what_ended_an_episode_with_a_ball_is_not_copied() -> None:
    made = kicks(50, kick(12, 0.0, ends=True))
    assert {len(columns[keys.TERMINATED]) for columns in made} == {11}
    assert not any(columns[keys.TERMINATED].any() for columns in made) and kicks(3, kick(5, 0.0, ends=True)) == []
