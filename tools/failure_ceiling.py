"""How well failures can be foreseen at all, by an oracle that knows all but the next commands.

    python tools/failure_ceiling.py antmaze-long --seed 1 --seed 2
    python tools/failure_ceiling.py nao-navigation --seed 1 --seed 2 --episodes 50 --clearance 0.2

Episodes of random commands are run in the target, as `collect` records them. Moments before their failures,
and safe ones, are continued many times from the very state that the target was in, under the command of that
moment for as long as it was held, and under new random ones after it. How many of these futures fail in a
window, and how many go on, are the oracle's odds; its AUC is that of what happened in the episode, as in
`astra_data.grounding.failures.foresight`. With more futures the AUC comes closer to the ceiling, from below.
"""

import copy
from dataclasses import dataclass, field
from typing import Annotated, Self

import numpy as np
import torch
import typer
from door import run_tool
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.seeding import derive, generator
from astra_data.grounding.failures import AHEAD_STEPS, ranked_above
from astra_data.training.behaviors import RandomCommands, WallWatch, held_steps
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

HOLD_S = (0.5, 3.0)
"""How long `collect` holds a random command, by default."""
FORESEEN_STEPS = AHEAD_STEPS[-1][1]
"""A moment is safe if no failure comes within these."""
NEVER = 10**6


class BranchingCommands(RandomCommands):
    """Random commands that can be continued from any moment in many ways."""

    def now(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the commands (B, A), and for how many steps (B,) they are still held."""
        return self._command.copy(), self._left.copy()

    def continued(self, command: NDArray[np.float64], held: int, futures: int, seed: int) -> Self:
        """Return commands of K futures of a robot whose command (A,) is held for `held` steps."""
        other = copy.copy(self)
        other._rng = generator(seed, "futures")
        other._command, other._left = np.zeros((futures, len(command))), np.full(futures, held)
        other._command[:] = command
        return other


@dataclass(frozen=True)
class Moment:
    """A moment of an episode.

    Attributes:
        state: of the target, by name. command: until then, (A,). held: steps for which it is still held.
        ahead: steps to the failure, NEVER if none came.
    """

    state: dict[str, Tensor]
    command: NDArray[np.float64]
    held: int
    ahead: int


@dataclass
class Recorded:
    """What is kept of B episodes while they run.

    Attributes:
        moments: by step, the target's state by name, and the commands. lengths: steps of each, (B,).
        failed: which failed, (B,).
    """

    lengths: NDArray[np.int64]
    failed: NDArray[np.bool_]
    moments: dict[int, tuple[dict[str, Tensor], NDArray[np.float64], NDArray[np.int64]]] = field(
        default_factory=dict
    )

    def chosen(self, safe: int, seed: int) -> list[Moment]:
        """Return all moments before failures, and some that are `safe`."""
        foreseen: list[Moment] = []
        going_on: list[Moment] = []
        for step, (state, command, held) in self.moments.items():
            for row in np.flatnonzero(self.lengths > step):
                ahead = int(self.lengths[row]) - step if self.failed[row] else NEVER
                rows = {name: values[row] for name, values in state.items()}
                moment = Moment(rows, command[row], int(held[row]), ahead)
                (foreseen if ahead <= FORESEEN_STEPS else going_on).append(moment)
        order = generator(seed, "safe moments").permutation(len(going_on))[:safe]
        return foreseen + [going_on[index] for index in order]


def main(
    task: str,
    seed: Annotated[list[int], typer.Option(help="Of the episodes.")],
    episodes: Annotated[int, typer.Option(help="To record.", min=2)] = 200,
    steps: Annotated[int, typer.Option(help="Of an episode at most.", min=1)] = 500,
    clearance: Annotated[float, typer.Option(help="clearance_m of the recipe's [collect].", min=0.0)] = 0.0,
    every: Annotated[int, typer.Option(help="Steps between moments.", min=1)] = 4,
    safe: Annotated[int, typer.Option(help="Safe moments, drawn at random.", min=1)] = 500,
    futures: Annotated[int, typer.Option(help="Of each moment.", min=2)] = 64,
) -> None:
    """Print two lines for each seed: with half of the futures, and with all."""
    world = task_named(task)
    watch = WallWatch(world, clearance) if clearance else None
    behavior = BranchingCommands(world.objective.action_size, held_steps(HOLD_S, world.timestep_s), watch)
    titles = ("seed", "failures", "moments", "futures", *(f"{first}-{last}" for first, last in AHEAD_STEPS))
    print(f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}")
    for one in seed:
        episodes_run = recorded(world, behavior, one, episodes, steps, every)
        moments = episodes_run.chosen(safe, one)
        ahead = np.array([moment.ahead for moment in moments])
        fails = np.stack(failures_after(world, behavior, moments, futures, one))
        for count in (futures // 2, futures):
            figures = (one, episodes_run.failed.sum(), len(moments), count)
            found = ceilings(fails[:, :count], ahead)
            told = ("-" if auc is None else f"{auc:.2f}" for auc in found)
            print(f"| {' | '.join(map(str, (*figures, *told)))} |", flush=True)


def recorded(
    task: Task, behavior: BranchingCommands, seed: int, episodes: int, steps: int, every: int
) -> Recorded:
    """Run B episodes of up to `steps` steps in the target; keep a moment of each `every` steps."""
    target = task.target(episodes, seed=derive(seed, "collect"), start_anywhere=True)
    target.reset()
    behavior.start(range(episodes), seed)
    active = torch.ones(episodes, dtype=torch.bool)
    kept = Recorded(np.full(episodes, steps), np.zeros(episodes, dtype=bool))
    for step in range(steps):
        if step % every == 0:
            state = target.state_dict()
            by_robot = {name: values for name, values in state.items() if values.shape[:1] == (episodes,)}
            kept.moments[step] = (by_robot, *behavior.now())
        outcome = target.step(behavior.act(target.state, target.goal), active)
        ended = active & outcome.terminated
        kept.lengths[ended.numpy()] = step + 1
        kept.failed |= (ended & target.failed).numpy()
        active &= ~ended
        if not active.any():
            break
    return kept


def failures_after(
    task: Task, behavior: BranchingCommands, moments: list[Moment], futures: int, seed: int
) -> list[NDArray[np.int64]]:
    """Return after how many steps each moment's futures fail, (K,) each, NEVER if not in any window."""
    target = task.target(futures, seed=derive(seed, "futures"), start_anywhere=True)
    found: list[NDArray[np.int64]] = []
    for number, moment in enumerate(moments):
        target.reset()
        state = target.state_dict()
        by_robot = {name for name, values in state.items() if values.shape[:1] == (futures,)}
        state |= {name: torch.stack([moment.state[name]] * futures) for name in by_robot}
        target.load_state_dict(state)
        commands = behavior.continued(moment.command, moment.held, futures, derive(seed, f"moment {number}"))
        fails, active = np.full(futures, NEVER), torch.ones(futures, dtype=torch.bool)
        for step in range(FORESEEN_STEPS):
            outcome = target.step(commands.act(target.state, target.goal), active)
            fails[(active & target.failed).numpy()] = step + 1
            active &= ~outcome.terminated
            if not active.any():
                break
        found.append(fails)
    return found


def ceilings(fails: NDArray[np.int64], ahead: NDArray[np.int64]) -> list[float | None]:
    """Return the oracle's AUC in each window, None without moments in it.

    Args:
        fails: steps to the failures of futures, (M, K).
        ahead: to those that happened, (M,).
    """
    go_on = (fails > FORESEEN_STEPS).sum(axis=1)
    found: list[float | None] = []
    for first, last in AHEAD_STEPS:
        within = ((fails >= first) & (fails <= last)).sum(axis=1)
        odds = (within + 0.5) / (go_on + 0.5)
        before, safe = odds[(ahead >= first) & (ahead <= last)], odds[ahead > FORESEEN_STEPS]
        found.append(ranked_above(before, safe))
    return found


if __name__ == "__main__":
    run_tool(main)
