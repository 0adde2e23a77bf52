"""How much a grounded simulator moves like the target under the commands of fresh episodes; print Markdown.

    python tools/check_scatter.py antmaze-long runs/x --row nas --seed 223 --fresh 224

Recorded commands of other seeds are replayed in a grounding, as it is and without its scatter. Paths over
chords of a second tell how much a robot weaves, changes of its velocity over 0.1 to 2 s how unsteady it is;
and how fast it walks along commands that are held for 2 s, 1.2 m away from walls, tells whether the
correction is biased. Positions are the first two entries of abstract states, meters.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import torch
import typer
from door import run_tool
from torch import Tensor

from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.open_loop import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import grounded_as
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task

LAGS_S = (0.1, 0.25, 0.5, 1.0, 2.0)
HELD_S = 2.0
CLEAR_M = 1.2
SPEEDS = ((0.2, 0.5), (0.5, 0.75), (0.75, 0.95), (0.95, 1.5))
"""Bins of the commands' lengths."""


def main(
    task: str,
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    fresh: Annotated[list[int], typer.Option(help="Seeds whose commands to replay.")],
    row: Annotated[str, typer.Option(help="Whose grounding.")] = "nas",
    seed: Annotated[int, typer.Option(help="Of the grounding.")] = 0,
) -> None:
    """Print two tables for each fresh seed."""
    world = task_named(task)
    grounding = load_grounding(run / "ground" / grounded_as(row) / f"seed_{seed}" / GROUNDING)
    if not isinstance(grounding, HistoryGrounding) or grounding.scatter_model is None:
        raise typer.BadParameter(f"{row} has no scatter model: expected [ground] scatter = true")
    torch.manual_seed(0)
    for one in fresh:
        episodes = PairedEpisodes.load(run / "pair" / f"seed_{one}")
        known = {"with scatter": grounding, "without": grounding.for_replay()}
        _print_motion(world, known, episodes, one)
        _print_speeds(world, known, episodes)


@torch.no_grad()
def replayed(task: Task, grounding: HistoryGrounding, moments: Moments, steps: int) -> Tensor:
    """Return positions (N, steps + 1, 2) along recorded commands, from each of N moments on."""
    simulator = grounding.simulator(task, len(moments))
    hidden = grounding.hidden_before(moments.windows)
    moments.start(simulator, hidden[moments.episode, moments.first])
    places = [moments.state[:, :2]]
    for step in range(steps):
        places.append(simulator.step(moments.action(step))[:, :2])
    return torch.stack(places, dim=1)


def _print_motion(
    task: Task, known: dict[str, HistoryGrounding], episodes: PairedEpisodes, seed: int
) -> None:
    windows, lengths = episodes.windows, episodes.lengths.tolist()
    whole = Moments.every(windows, windows.mask.shape[1])
    paths = {"recorded": torch.cat([windows.state[:, :1], windows.next_state], dim=1)[..., :2]}
    paths |= {name: replayed(task, one, whole, windows.mask.shape[1]) for name, one in known.items()}
    titles = " | ".join(f"change over {lag} s" for lag in LAGS_S)
    print(f"\n| commands of seed {seed} | path / chords | {titles} |\n|---|{'---|' * (len(LAGS_S) + 1)}")
    for name, path in paths.items():
        each = [places[: length + 1] for places, length in zip(path, lengths, strict=True)]
        changes = " | ".join(f"{_unsteadiness(each, task.timestep_s, lag):.2f} m/s" for lag in LAGS_S)
        print(f"| {name} | {_weaving(each, round(1 / task.timestep_s)):.2f} | {changes} |")


def _weaving(paths: list[Tensor], steps: int) -> float:
    """Return the length of paths (T + 1, 2) over that of their chords of so many steps."""
    walked, straight = 0.0, 0.0
    for places in paths:
        last = (len(places) - 1) // steps * steps
        walked += float(places[: last + 1].diff(dim=0).norm(dim=-1).sum())
        straight += float(places[: last + 1 : steps].diff(dim=0).norm(dim=-1).sum())
    return walked / straight


def _unsteadiness(paths: list[Tensor], timestep_s: float, lag_s: float) -> float:
    """Return the root mean square of how much the velocity over two steps changes within `lag_s`."""
    lag = round(lag_s / timestep_s)
    velocities = ((places[2:] - places[:-2]) / (2 * timestep_s) for places in paths)
    changes = torch.cat([(one[lag:] - one[:-lag]).norm(dim=-1) for one in velocities])
    return float(changes.square().mean().sqrt())


def _print_speeds(task: Task, known: dict[str, HistoryGrounding], episodes: PairedEpisodes) -> None:
    steps = round(HELD_S / task.timestep_s)
    held = list(_held(task, episodes, steps))
    if not held:
        print(f"\nNo command is held for {HELD_S:g} s away from walls.")
        return
    episode, first = torch.tensor(held).unbind(1)
    moments, windows = Moments(episodes.windows, episode, first), episodes.windows
    after = torch.stack([windows.next_state[episode, first + step, :2] for step in range(steps)], dim=1)
    paths = {"recorded": torch.cat([moments.state[:, None, :2], after], dim=1)}
    paths |= {name: replayed(task, one, moments, steps) for name, one in known.items()}
    command = windows.action[episode, first]
    length, half_s = command.norm(dim=-1), (steps - steps // 2) * task.timestep_s
    print(f"\n| command, in the second second | held | {' | '.join(paths)} |\n|---|---|{'---|' * len(paths)}")
    for low, high in SPEEDS:
        of = (length >= low) & (length < high)
        along = (command / length[:, None])[of]
        speeds = [
            float(((path[of, -1] - path[of, steps // 2]) * along).sum(-1).mean()) / half_s
            for path in paths.values()
        ]
        told = " | ".join(f"{speed:.2f} m/s" for speed in speeds)
        print(f"| {float(length[of].mean()):.2f} | {int(of.sum())} | {told} |")


def _held(task: Task, episodes: PairedEpisodes, steps: int) -> Iterator[tuple[int, int]]:
    """Yield episode and step of each command that is held for so many steps, clear of walls."""
    windows = episodes.windows
    for episode, length in enumerate(episodes.lengths.tolist()):
        action, places = windows.action[episode, :length], windows.next_state[episode, :length, :2]
        changed = (action.diff(dim=0).abs().sum(-1) > 1e-6).nonzero()[:, 0] + 1
        begun = [0, *changed.tolist()]
        for begin, end in zip(begun, [*begun[1:], length], strict=True):
            if end - begin >= steps:
                on_the_way = places[begin : begin + steps].numpy()
                if task.maze.clearance(on_the_way).min() >= CLEAR_M:
                    yield episode, begin


if __name__ == "__main__":
    run_tool(main)
