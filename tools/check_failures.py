"""How well failures are predicted on fresh episodes, by how many a failure model has seen; print Markdown.

    python tools/check_failures.py antmaze-long runs/x --fresh 3 --fresh 4 --episodes 50
    python tools/check_failures.py cart.py:TASK runs/x --row astra --fresh 1

Failure models are fitted to a seed's paired episodes, as they are replayed in its grounding, and measured on
those of other seeds, replayed there as well; and the recorded commands are replayed as a whole, where the
model is to expect as many failures as were recorded.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from door import run_tool

from astra_data.grounding.failures import AHEAD_STEPS, failure_figures, fit_failures, has_failures
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import grounded_as
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task


def main(
    task: str,
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    fresh: Annotated[list[int], typer.Option(help="Seeds whose episodes to measure on.")],
    row: Annotated[str, typer.Option(help="Whose grounding.")] = "nas",
    seed: Annotated[int, typer.Option(help="Of the grounding, and of the episodes to fit to.")] = 0,
    episodes: Annotated[list[int] | None, typer.Option(help="First episodes to fit to, besides all.")] = None,
    ahead: Annotated[list[str] | None, typer.Option(help='Steps before a failure, such as "1-5".')] = None,
) -> None:
    """Print a line for each model and dataset."""
    world = task_named(task)
    measured = {one: PairedEpisodes.load(run / "pair" / f"seed_{one}") for one in fresh}
    windows = [_window(one) for one in ahead or ()] or list(AHEAD_STEPS)
    grounding = load_grounding(run / "ground" / grounded_as(row) / f"seed_{seed}" / GROUNDING)
    if not isinstance(grounding, HistoryGrounding):
        raise typer.BadParameter(f"{row} has no history grounding")
    whole = PairedEpisodes.load(run / "pair" / f"seed_{seed}")
    titles = " | ".join(f"{first}-{last}" for first, last in windows)
    print(f"| fitted to | failures | on seed | {titles} | Brier skill |")
    print("|---|---|---|" + "---|" * (len(windows) + 1))
    for count in [*(episodes or []), len(whole)]:
        part = whole.select(torch.arange(count))
        if not has_failures(world, part):
            continue
        fitted, _ = fit_failures(world, grounding, part, seed=0)
        failures = int(part.windows.fails_soon.any(1).sum())
        for name, others in measured.items():
            found = failure_figures(world, grounding, fitted, others, windows)
            print(f"| {count} episodes | {failures} | {name} {_figures(found, len(windows))}")
    if grounding.failures is not None:
        _print_rates(world, grounding, measured)


def _window(given: str) -> tuple[int, int]:
    first, _, last = given.partition("-")
    if not (first.isdecimal() and last.isdecimal() and 0 < int(first) <= int(last)):
        raise typer.BadParameter(f'--ahead: expected first and last steps such as "1-5", got {given!r}')
    return int(first), int(last)


def _figures(found: Mapping[str, Any], windows: int) -> str:
    if not found["failures"]:
        return "| " * (windows + 2) + "|"
    texts = [
        "-" if value is None else f"{value:.2f}" for value in (*found["auc"].values(), found["brier_skill"])
    ]
    return f"({found['failures']} failures) | {' | '.join(texts)} |"


@torch.no_grad()
def _print_rates(task: Task, grounding: HistoryGrounding, measured: Mapping[int, PairedEpisodes]) -> None:
    """Print failures in 1000 steps: recorded, and expected along the same commands in the simulator."""
    print("\n| commands of seed | recorded | expected |\n|---|---|---|")
    for name, episodes in measured.items():
        windows, expected = episodes.windows, 0.0
        simulator = grounding.simulator(task, len(episodes))
        simulator.start(windows.state[:, 0], torch.arange(len(episodes)), windows.goal[:, 0])
        for action, mask in zip(windows.action.unbind(1), windows.mask.unbind(1), strict=True):
            simulator.step(action)
            risk = simulator.failure_risk()
            assert risk is not None
            expected += float((risk * mask).sum())
        steps, recorded = float(windows.mask.sum()), int(windows.fails_soon.any(1).sum())
        print(f"| {name} | {1e3 * recorded / steps:.2f} | {1e3 * expected / steps:.2f} |")


if __name__ == "__main__":
    run_tool(main)
