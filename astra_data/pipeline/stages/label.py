"""Label: what a log lacks of goals, rewards, successes and failures, as the task computes them from φ(s)."""

import logging
from pathlib import Path

import numpy as np

from astra_data.core.arrays import as_column, as_rows
from astra_data.core.durable import folder_for, held, make_folder, refuse_existing
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import generator
from astra_data.dataset import columns as names
from astra_data.dataset.checkup import continuity, torn_steps
from astra_data.dataset.columns import Array, Episode
from astra_data.dataset.inspection import is_terminated, outcome_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import column_faults, names_apart, next_version
from astra_data.io.hub.sharing import opened
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import explained, judged, paid

_log = logging.getLogger(__name__)


def label(
    task: str,
    *,
    data: str | Path,
    seed: int = 0,
    name: str | None = None,
    out: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Add the columns of goals and outcomes that a dataset lacks; return the new folder.

    Goals are drawn by the objective, one an episode. Episodes end where the goal is reached: later steps are
    dropped. An episode that its log ends as terminated, without a success, is a failure. `data` is a folder, a
    name, or an address to pull it from. Where it lacks nothing, `out` becomes a link to it.

    Raises:
        BadInputError: states, actions or next states are not those of the task, or nothing is to be labeled.
        SharingError: it cannot be pulled.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import label
        >>> labeled = label("antmaze-umaze", data="walks", out=Path("labeled"))  # lacks nothing: a link
    """
    world, source = task_named(task), _opened(data, out)
    check_fits(source, world)
    more = [one for one in (world.goal, *names.OUTCOME_COLUMNS) if one and one.name not in source.features]
    for warning in remarks(source, world):
        _log.warning(warning)
    if not more:
        if out is None:
            raise BadInputError(f"{source.reference} already has goals and outcomes: there is nothing to label")
        refuse_existing(out)
        make_folder(out.parent)
        out.symlink_to(source.root.resolve())
        return out
    steps = successes = failures = at_goal = 0
    settings = {"task": world.name, "seed": seed, "columns": [column.name for column in more]}
    with next_version(source, "columns", stage="label", config=settings, name=name, out=out, more=more) as writer:
        for number, episode in enumerate(source.episodes(), start=1):
            labeled = with_outcomes(world, episode, seed)
            writer.add(labeled)
            steps += len(labeled)
            successes += bool(labeled.metadata["success"])
            failures += bool(labeled.metadata["failed"])
            if names.SUCCESS not in episode.columns and labeled.metadata["failed"]:
                after = _abstracted(world, labeled.columns[names.NEXT_STATE][-1:])
                at_goal += bool(judged(world.objective, "reached", after, _goals(world, labeled, seed)[-1:]))
            progress(number / len(source), f"{successes} successes, {failures} failures in {steps:,} steps")
        writer.made = {"dropped_steps": int(source.lengths.sum()) - steps}
    if at_goal:
        fault = f"{at_goal} episodes terminate at their goal and are labeled as failures, because {names.TERMINATED}"
        advice = f"also import {names.SUCCESS} if they ended on arrival"
        _log.warning("%s", f"{source.reference}: {fault} does not say why: {advice}")
    return writer.root


def _opened(data: str | Path, out: Path | None) -> Dataset:
    """Open the data, or pull them; of seeds that are labeled at once, one does while the others wait."""
    if out is None:
        return opened(data)
    with folder_for(out), held(out.parent, wait=True):
        return opened(data)


def remarks(source: Dataset, task: Task) -> list[str]:
    """Say what is to be checked of a dataset that fits a task."""
    apart = continuity({one.uid: torn_steps(one) for one in source.episodes([names.STATE, names.NEXT_STATE])})
    found = [f"{finding.what}: {finding.advice}" for finding in apart]
    if named := names_apart(source, (task.state, task.action), task.name):
        found.append(named)
    has_ends = names.TERMINATED in source.features and names.SUCCESS not in source.features
    if has_ends and all(is_terminated(episode.columns) for episode in source.episodes([names.TERMINATED])):
        found.append(
            f"{source.reference}: each of the {len(source)} episodes ends as {names.TERMINATED} and counts as a "
            f"failure, as there is no {names.SUCCESS}: import that too if they succeeded, or leave {names.TERMINATED} "
            "out of the mapping if it only marks where each recording ends"
        )
    if task.goal is not None and names.GOAL not in source.features:
        alike = [name for name in source.features if "goal" in name.lower()]
        mistaken = f" ({', '.join(alike)} is not read as one)" if alike else ""
        found.append(
            f"{source.reference} has no {names.GOAL}{mistaken}: goals are drawn by the objective, one an episode "
            f"(goal_size is {task.objective.goal_size}); import those that the robot had into that column"
        )
    return found


def with_outcomes(task: Task, episode: Episode, seed: int) -> Episode:
    """Return the episode with goals and outcomes, up to its first success; what it has of them is kept."""
    given = episode.columns
    before, after = (_abstracted(task, given[key]) for key in (names.STATE, names.NEXT_STATE))
    goal = _goals(task, episode, seed)
    over = torch.from_numpy(given.get(names.TERMINATED, np.zeros(len(episode), bool)))
    missed = judged(task.objective, "missed", after, goal)
    reached = judged(task.objective, "reached", after, goal) & ~over
    success = torch.from_numpy(given[names.SUCCESS]) if names.SUCCESS in given else reached.clone()
    failed = (over | missed) & ~success
    if names.SUCCESS in given:
        reached = reached if task.objective.is_lasting else success  # that what is to last did so ends no episode
    else:
        late = slice(task.objective.horizon - 1, None)
        success[late] = task.objective.succeeded(reached[late], failed[late], task.objective.horizon)
    reward = paid(task.objective, before, after, goal, failed).numpy()
    terminated = (reached | failed).numpy()
    length = int(terminated.argmax()) + 1 if terminated.any() else len(episode)
    truncated = np.zeros(len(episode), bool)
    truncated[length - 1] = not terminated[length - 1]
    columns: dict[str, Array] = {names.GOAL: as_column(goal.numpy())} if task.goal else {}
    columns |= {names.REWARD: reward.astype(np.float32), names.SUCCESS: success.numpy(), **given}
    columns |= {names.TERMINATED: terminated, names.TRUNCATED: truncated, names.DONE: terminated | truncated}
    kept = {key: values[:length] for key, values in columns.items()}
    cameras = {name: clip.part(0, length) for name, clip in episode.cameras.items()}
    return Episode(episode.uid, kept, dict(episode.metadata) | outcome_of(kept), cameras)


def _abstracted(task: Task, states: Array) -> Tensor:
    """Return φ (T, X) of recorded states."""
    with explained("abstraction (φ) of the recorded states"):
        return torch.from_numpy(np.ascontiguousarray(task.abstraction(as_rows(states)), dtype=np.float32))


def _goals(task: Task, episode: Episode, seed: int) -> Tensor:
    if names.GOAL in episode.columns:
        return torch.from_numpy(as_rows(episode.columns[names.GOAL]))
    with explained("objective.draw_goals(rng, 1)"):
        drawn = task.objective.draw_goals(generator(seed, f"goal of episode {episode.uid}"), 1)
    return torch.from_numpy(drawn).float().expand(len(episode), -1).contiguous()


def check_fits(source: Dataset, task: Task) -> None:
    """Check that a dataset has the states and actions of a task."""
    faults, fps = [], source.info["fps"]
    if fps != task.fps:
        expects = f"expected the {task.fps} of {task.name}, whose timestep_s is {task.timestep_s:g}"
        faults.append(f"has {fps} steps per second, {expects}")
    for expected in (task.state, task.action):
        faults += column_faults(source, expected, task.name)
    goal_size = task.goal.size if task.goal else 0
    if names.GOAL in source.features and (found := source.features[names.GOAL]["shape"][0]) != goal_size:
        fault = f"has {found} values, goals of {task.name} have {goal_size}"
        faults.append(f"{names.GOAL} {fault}: import it without that column")
    kinds = {flag.name: source.features.get(flag.name, {}).get("dtype", "bool") for flag in names.OUTCOME_COLUMNS[1:]}
    faults += [f"{name} is {kind}, expected bool" for name, kind in kinds.items() if kind != "bool"]
    if names.NEXT_STATE not in source.features:
        faults.append(f"has no column {names.NEXT_STATE}")
    if faults:
        raise BadInputError(f"{source.reference} {'; '.join(faults)}")
