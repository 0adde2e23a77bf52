"""Augment: more episodes from few, by rotating and translating them on the floor.

The robot's dynamics do not depend on where it is and which way it faces, so a moved episode is one that the
robot could have recorded, with three exceptions:

* Walls: only stretches of an episode that keep clear of them are copied, and the copies keep clear of them too.
* The goal belongs to the maze: every copy gets a goal of its own, drawn as the task draws it, which computes the
  copy's rewards and ends. A ball is moved with its robot; where it was may have ended its episode, so that step
  is not copied.
* Commands: where they are clipped along each axis, rotations out of that square are drawn again.

Held-out episodes are chosen first and never copied. Pairing comes later, so that pairs are exact.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from astra_data.core.arrays import Bools
from astra_data.core.config import Config, Count, NotNegative
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import derive, generator, held_out_episodes
from astra_data.dataset import columns as names
from astra_data.dataset.columns import ABSTRACT_STATE, GOAL, NEXT_STATE, OUTCOME_COLUMNS, STATE, Array, Column, Episode
from astra_data.dataset.inspection import outcome_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import column_faults, next_version, open_dataset
from astra_data.robots.registry import TASKS, task_named
from astra_data.worlds.geometry import PlanarMap
from astra_data.worlds.objective import Objective
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import is_user_code

Rotations = Literal["quarter", "any", "none"]

_COPIES = 3  # of each training episode, unless the number of episodes is given
_TRIES, _SHIFTS = 100, 64  # rotations that are tried for a copy, and shifts for each rotation
_ROUNDING = 1e-6  # how far a rotated command may exceed the limit
_log = logging.getLogger(__name__)
_OUTCOMES = tuple(column.name for column in OUTCOME_COLUMNS)


def positions(task: Task, states: Array) -> Array:
    """Return the robot's position (T, 2) in m in target states `states` (T, S)."""
    group = next(group for role, group in task.abstract_state.roles if role == "position")
    return np.ascontiguousarray(task.abstraction(states)[:, group])


@dataclass(frozen=True)
class Relocation:
    """How segments of episodes of `min_steps` or more may be moved within the maze of `task`, `margin_m` from walls."""

    task: Task
    rotations: Rotations
    translations: bool  # to anywhere; otherwise a segment starts where it did
    margin_m: float
    min_steps: int

    def stretches(self, episode: Episode) -> list[tuple[int, int]]:
        """Return first step and end of each segment of `episode` that may be moved."""
        free = np.ones(len(episode), dtype=bool)
        for name in (names.STATE, names.NEXT_STATE):
            free &= self._is_free(positions(self.task, episode.columns[name]))
        edges = np.flatnonzero(np.diff(free, prepend=False, append=False)).reshape(-1, 2)
        return [(int(first), int(end)) for first, end in edges if end - first >= self.min_steps]

    def placements(self, episode: Episode, rng: np.random.Generator) -> Iterator[tuple[PlanarMap, slice]]:
        """Draw segments of `episode`, in proportion to their lengths, and a placement for each; try `_TRIES` times."""
        stretches = self.stretches(episode)
        lengths = np.array([end - first for first, end in stretches])
        least, largest = np.array(list(self.task.limits.values())).T
        for _ in range(_TRIES if stretches else 0):
            steps = slice(*stretches[rng.choice(len(stretches), p=lengths / lengths.sum())])
            angle = {"quarter": rng.integers(4) * np.pi / 2, "any": rng.uniform(-np.pi, np.pi), "none": 0.0}
            turn = PlanarMap(float(angle[self.rotations]))
            action = turn.of_column(self.task.action, episode.columns[names.ACTION][steps])
            if not ((action >= least - _ROUNDING) & (action <= largest + _ROUNDING)).all():
                continue
            ends = [positions(self.task, episode.columns[name][steps]) for name in (names.STATE, names.NEXT_STATE)]
            path = turn.positions(np.concatenate(ends).astype(np.float64))
            shifts = np.asarray(ends[0][0] - path[0])[None]
            if self.translations:  # those that keep the path inside the maze, where it fits
                room = self.task.maze.half_extent
                low, high = -room - path.min(axis=0), room - path.max(axis=0)
                shifts = rng.uniform(low, np.maximum(low, high), (_SHIFTS, 2))
            # Rounded to float32, as datasets store them.
            fits = self._is_free((path + shifts[:, None]).astype(np.float32)).all(axis=1)
            if fits.any():
                x, y = shifts[fits.argmax()]
                yield PlanarMap(turn.rotation_rad, (float(x), float(y))), steps

    def copied(
        self, episode: Episode, moving: Sequence[Column], rng: np.random.Generator
    ) -> tuple[dict[str, Array], PlanarMap, slice] | None:
        """Move some steps of `episode`, with a new goal, judged by the task: columns, motion, steps; None: no room."""
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
                return {name: values[:length] for name, values in columns.items()} | judged, change, steps
        return None

    def _is_free(self, points: Array) -> Array:
        return self.task.maze.clearance(points) > self.margin_m


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


class AugmentConfig(Config):
    """How many copies, and how they may differ; the paper makes 200 episodes of 50 by rotating and moving."""

    episodes: Count | None = None
    """Total number of episodes, including originals and held-out ones; by default each training episode gets
    three copies."""
    rotations: Rotations = "any"
    """"any": by any angle that keeps the commands within their limits, which is rarer for longer commands.
    "quarter": by multiples of 90 degrees, each equally often, since these always keep commands within limits."""
    translations: bool = True
    """Move copies anywhere in the maze; otherwise a copy starts where the original did."""
    held_out_share: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Fraction of the episodes to hold out first, at least one episode unless it is 0."""
    margin_m: NotNegative | None = None
    """Minimum distance to walls of copies and their originals; by default the robot's reach. With less,
    copies are longer but some of their steps are wrong: the robot stops at walls that are not there, or walks
    through walls that are (8 % of the steps on the U-Maze with 0.6 m, none with the ant's reach)."""
    min_steps: Count = 20
    """Length of the shortest stretch that is copied."""

    @model_validator(mode="after")
    def _changes_something(self) -> Self:
        if not self.translations and self.rotations == "none":
            raise ValueError("translations: expected rotations or translations, got neither")
        return self


def augment(
    task: str | None = None,
    config: AugmentConfig = AugmentConfig(),
    *,
    dataset: str | Path,
    seed: int = 0,
    name: str | None = None,
    out: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Write a version of `dataset` with copies of its training episodes; return its folder.

    Every episode's metadata says whether it is `held_out`; a copy's also `source_episode` (uid),
    `augmentation_first_step` (of the source) and the map from it, p ↦ R(`augmentation_rotation_rad`) p +
    (`augmentation_x_m`, `augmentation_y_m`). By default `task`, which computes rewards and ends of copies, is the one
    that the dataset was collected for, and the new version is at home.

    Raises:
        BadInputError: the task has no maze; the dataset does not fit it, was paired or augmented, has
            columns without roles, or has no stretch to copy or no place for any copy.
        CorruptDatasetError: `dataset` is incomplete.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import Dataset, augment
        >>> from astra_data.pipeline.stages.augment import AugmentConfig
        >>> turned = augment(config=AugmentConfig(episodes=16), dataset="walks", out=Path("turned"))
        >>> len(Dataset.open(turned))
        16
    """
    source = open_dataset(dataset)
    world = _task_of(source, task)
    _check(source, world)
    margin_m = world.wall_reach_m if config.margin_m is None else config.margin_m
    relocation = Relocation(world, config.rotations, config.translations, margin_m, config.min_steps)
    held_out, copies = _shares(source, relocation, config, seed)
    if source.cameras:
        _log.warning(f"{', '.join(source.cameras)} left out: no camera has seen the moved episodes")
    taken, placed, lost, moving = set(source.uids.tolist()), 0, 0, _moving(source)
    settings, seeds = config.model_dump(mode="json"), source.description["seeds"] | {"augment": seed}
    with next_version(
        source, "episodes", cameras=False, stage="augment", config=settings, name=name, out=out, seeds=seeds
    ) as writer:
        for index, episode in enumerate(source.episodes()):
            original = {**episode.metadata, "held_out": bool(held_out[index])}
            writer.add(Episode(episode.uid, episode.columns, original))
            for copy in range(copies[index]):
                copied = relocation.copied(episode, moving, generator(seed, f"augment {episode.uid} {copy}"))
                if copied is None:
                    lost += 1
                    continue
                purpose = f"{source.content_hash} {config.model_dump_json()} {episode.uid} {copy}"
                columns, change, kept = copied
                metadata = outcome_of(columns) | {
                    "held_out": False,
                    "source_episode": episode.uid,
                    "augmentation_first_step": int(kept.start),
                    "augmentation_rotation_rad": change.rotation_rad,
                    "augmentation_x_m": change.shift_m[0],
                    "augmentation_y_m": change.shift_m[1],
                }
                taken.add(uid := names.new_uid(derive(seed, purpose), b"", taken))
                writer.add(Episode(uid, columns, metadata))
                placed += 1
            progress((index + 1) / len(source), f"{placed} copies, no place for {lost}")
        if copies.any() and not placed:
            advice = f"lower --margin-m ({relocation.margin_m:g} m) or --min-steps"
            raise BadInputError(f"{source.reference}: found no place for any of {lost} copies: {advice}")
        skipped = int((~held_out & (copies == 0)).sum())
        writer.made = {"copies": placed, "copies_without_place": lost, "episodes_not_copied": skipped}
    return writer.root


def _task_of(source: Dataset, task: str | None) -> Task:
    called, collected_for = source.reference, source.description["environment"].get("id")
    if task is None and collected_for is None:
        raise BadInputError(f"{called} does not name its task: give --task")
    if task is None and is_user_code(str(collected_for)):
        advice = f"whose code would be run: read it, then give --task {collected_for}"
        raise BadInputError(f"{called} was collected for {collected_for}, {advice}")
    if task is not None and collected_for in TASKS and task != collected_for:
        raise BadInputError(f"{called} was collected for {collected_for}, not for {task}")
    return task_named(task or str(collected_for))


def _check(source: Dataset, world: Task) -> None:
    faults = [f"has no column {name}" for name in _OUTCOMES if name not in source.features]
    faults += [fault for expected in world.state_columns for fault in column_faults(source, expected, world.name)]
    if ABSTRACT_STATE in source.features:
        faults.append(f"{ABSTRACT_STATE}: it has been paired; augment its parent, then pair")
    if "held_out" in source.metadata:
        faults.append("held_out: it has been augmented; augment its parent")
    faults += [f"{one.name}: it has no roles, which say how it is rotated" for one in _moving(source) if not one.roles]
    if faults:
        raise BadInputError(f"{source.root} cannot be augmented for {world.name}: {'; '.join(faults)}")


def _moving(source: Dataset) -> list[Column]:
    """Return the columns that are transformed: all of floats but the goal and the outcomes."""
    still = (*_OUTCOMES, GOAL)
    return [column for column in source.schema if column.dtype == "float32" and column.name not in still]


def _shares(source: Dataset, mover: Relocation, config: AugmentConfig, seed: int) -> tuple[Bools, NDArray[np.intp]]:
    """Return which episodes are held out (E,), and how many copies each is to have (E,)."""
    count, recordings = len(source), source.recordings
    training, held = held_out_episodes(int(recordings.max()) + 1, config.held_out_share, seed)
    held_out = np.isin(recordings, held)  # a recording may have several parts
    usable = ~held_out
    for index, episode in enumerate(source.episodes([STATE, NEXT_STATE])):
        usable[index] &= bool(mover.stretches(episode))
    if not usable.any():
        raise BadInputError(
            f"{source.reference}: none of {(~held_out).sum()} training episodes keeps {mover.margin_m:g} m "
            f"from the walls for {config.min_steps} steps: lower --margin-m, --min-steps or --held-out-share "
            f"({held_out.sum()} episodes)"
        )
    copies = np.zeros(count, dtype=np.intp)
    copies[usable] = _COPIES
    if config.episodes is not None:
        if config.episodes < count:
            raise BadInputError(f"--episodes {config.episodes}: expected at least {count}, the number of originals")
        each, more = divmod(config.episodes - count, int(usable.sum()))
        copies[usable] = each
        drawn = np.argsort(np.argsort(np.append(training, held))[recordings], kind="stable")
        copies[drawn[usable[drawn]][:more]] += 1
    return held_out, copies
