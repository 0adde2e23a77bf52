"""Candidate placements of an episode elsewhere in its maze, and its rewards and outcome there."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch

from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array, Column, Episode
from astra_data.worlds.geometry import PlanarMap
from astra_data.worlds.objective import Objective
from astra_data.worlds.task import Task

Rotations = Literal["quarter", "any", "none"]

_SHIFTS = 64  # shifts that are tried for each rotation
_ROUNDING = 1e-6  # how far a rotated command may exceed the limit


def positions(task: Task, states: Array) -> Array:
    """Return the robot's position (T, 2) in m in target states `states` (T, S)."""
    group = next(group for role, group in task.abstract_state.roles if role == "position")
    return np.ascontiguousarray(task.abstraction(states)[:, group])


class Copy(NamedTuple):
    """A moved part of an episode: its columns, how they were moved, and its steps of the episode."""

    columns: dict[str, Array]
    change: PlanarMap
    steps: slice


@dataclass(frozen=True)
class Relocation:
    """How segments of episodes of `min_steps` or more may be moved within the maze of `task`, `margin_m` from walls."""

    task: Task
    rotations: Rotations
    translations: bool  # to anywhere; otherwise a segment starts where it did
    margin_m: float
    min_steps: int
    tries: int  # rotations that are drawn, with 64 shifts for each, before a segment is given up

    def stretches(self, episode: Episode) -> list[tuple[int, int]]:
        """Return first step and end of each segment of `episode` that may be moved."""
        free = np.ones(len(episode), dtype=bool)
        for name in (names.STATE, names.NEXT_STATE):
            free &= self._is_free(positions(self.task, episode.columns[name]))
        edges = np.flatnonzero(np.diff(free, prepend=False, append=False)).reshape(-1, 2)
        return [(int(first), int(end)) for first, end in edges if end - first >= self.min_steps]

    def placements(self, episode: Episode, rng: np.random.Generator) -> Iterator[tuple[PlanarMap, slice]]:
        """Draw segments of `episode`, in proportion to their lengths, and a placement for each, `tries` times."""
        stretches = self.stretches(episode)
        lengths = np.array([end - first for first, end in stretches])
        least, largest = np.array(list(self.task.limits.values())).T
        for _ in range(self.tries if stretches else 0):
            steps = slice(*stretches[rng.choice(len(stretches), p=lengths / lengths.sum())])
            angle = {"quarter": rng.integers(4) * np.pi / 2, "any": rng.uniform(-np.pi, np.pi), "none": 0.0}
            turn = PlanarMap(float(angle[self.rotations]))
            action = turn.of_column(self.task.action, episode.columns[names.ACTION][steps])
            if not ((action >= least - _ROUNDING) & (action <= largest + _ROUNDING)).all():
                continue
            ends = [positions(self.task, episode.columns[name][steps]) for name in (names.STATE, names.NEXT_STATE)]
            path = turn.positions(np.concatenate(ends).astype(np.float64))
            shifts = self._draw_shifts(ends[0][0], path, rng)
            # Rounded to float32, as datasets store them.
            fits = self._is_free((path + shifts[:, None]).astype(np.float32)).all(axis=1)
            if fits.any():
                x, y = shifts[fits.argmax()]
                yield PlanarMap(turn.rotation_rad, (float(x), float(y))), steps

    def copied(self, episode: Episode, moving: Sequence[Column], rng: np.random.Generator) -> Copy | None:
        """Move a part of `episode`, with a goal of its own, judged by the task; None where there is no room."""
        world, movable, has_ball = self.task, episode, self.task.ball_index is not None
        if has_ball and episode.columns[names.TERMINATED][-1]:
            movable = replace(episode, columns={name: each[:-1] for name, each in episode.columns.items()})
        for change, steps in self.placements(movable, rng):
            cut = {name: values[steps] for name, values in movable.columns.items()}
            moved = {column.name: change.of_column(column, cut[column.name]) for column in moving}
            goal = world.objective.draw_goals(rng, 1)[0].astype(np.float32)
            columns = cut | moved | {names.GOAL: np.tile(goal, (len(cut[names.GOAL]), 1))}
            before, after = (np.asarray(world.abstraction(columns[name])) for name in (names.STATE, names.NEXT_STATE))
            first = (torch.from_numpy(before[:1]), torch.from_numpy(goal[None]))
            if not has_ball or not world.objective.decided(*first):
                judged = outcomes(world.objective, before, after, goal, cut[names.TERMINATED] & ~cut[names.SUCCESS])
                length = len(judged[names.DONE])
                return Copy({name: values[:length] for name, values in columns.items()} | judged, change, steps)
        return None

    def _is_free(self, points: Array) -> Array:
        return self.task.maze.clearance(points) > self.margin_m

    def _draw_shifts(self, start: Array, path: Array, rng: np.random.Generator) -> Array:
        """Draw shifts (n, 2) that keep `path` (T, 2) inside the maze where it fits."""
        if not self.translations:
            return np.asarray(start - path[0])[None]
        room = self.task.maze.half_extent
        low, high = -room - path.min(axis=0), room - path.max(axis=0)
        return rng.uniform(low, np.maximum(low, high), (_SHIFTS, 2))


def outcomes(objective: Objective, before: Array, after: Array, goal: Array, toppled: Array) -> dict[str, Array]:
    """Return the outcome columns (T',) of steps between abstract states (T, X), up to the one that ends the episode."""
    start, end = torch.from_numpy(before), torch.from_numpy(after)
    goals = torch.from_numpy(goal).expand(len(start), 2)
    success = objective.reached(end, goals)
    failed = (torch.from_numpy(toppled) | objective.missed(end, goals)) & ~success
    terminated = (success | failed).numpy()
    length = int(terminated.argmax()) + 1 if terminated.any() else len(terminated)
    done = np.arange(length) == length - 1
    return {
        names.REWARD: objective.reward(start, end, goals, failed).numpy()[:length],
        names.TERMINATED: terminated[:length],
        names.TRUNCATED: done & ~terminated[:length],
        names.DONE: done,
        names.SUCCESS: success.numpy()[:length],
    }
