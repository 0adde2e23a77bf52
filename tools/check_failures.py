"""How well failures are foreseen on fresh episodes, by how many a failure model has seen; print Markdown.

    python tools/check_failures.py antmaze-long PAIRS --fresh OTHER --fresh THIRD --episodes 50
    python tools/check_failures.py cart.py:TASK PAIRS --fresh OTHER --grounding runs/x/ground/nas/seed_0

Datasets are paired. With groundings, their topple head and R_pred are measured on the same episodes, and the
recorded commands are replayed in them: the rate of failures that the failure model expects there is to be the
recorded one, by how much the simulator's states are scattered.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from astra_data.grounding.failures import AHEAD_STEPS, compared_foresight, fit_failures, foresight
from astra_data.grounding.files import load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

SCATTERS = (0.0, 0.5, 1.0)
"""Of the simulator's states, in units of the target's scatter around it."""


def main(
    task: str,
    pairs: Annotated[list[Path], typer.Argument(help="Datasets to fit failure models to, each by itself.")],
    fresh: Annotated[list[Path], typer.Option(help="Datasets to measure on.")],
    episodes: Annotated[list[int] | None, typer.Option(help="First episodes to fit to, besides all.")] = None,
    grounding: Annotated[list[Path] | None, typer.Option(help="Folders of history groundings.")] = None,
    members: Annotated[int, typer.Option(help="Networks of each failure model.")] = 5,
    ahead: Annotated[list[str] | None, typer.Option(help='Steps before a failure, such as "1-5".')] = None,
) -> None:
    """Print a line for each model and dataset."""
    world, measured = task_named(task), {path.name: PairedEpisodes.load(path) for path in fresh}
    windows = [(int(first), int(last)) for first, _, last in (one.partition("-") for one in ahead or ())]
    windows = windows or list(AHEAD_STEPS)
    titles = " | ".join(f"{first}-{last}" for first, last in windows)
    print(f"| fitted to | episodes | failures | on | {titles} | Brier skill |")
    print("|---|---|---|---|" + "---|" * (len(windows) + 1))
    for path in pairs:
        whole = PairedEpisodes.load(path)
        for count in [*(episodes or []), len(whole)]:
            part = whole.select(torch.arange(count))
            model = fit_failures(world, part, members, seed=0)
            failures = int(part.windows.topples_soon.any(1).sum())
            if model is None:
                continue
            for name, others in measured.items():
                found = foresight(model.probability(model.histories(others.windows)[0]), others, windows)
                print(f"| {path.name} | {count} | {failures} | {name} {_figures(found)}")
    for path in grounding or []:
        made = load_grounding(path / "grounding.safetensors")
        if not isinstance(made, HistoryGrounding):
            raise typer.BadParameter(f"{path} is no history grounding")
        predicts_reward = bool(made.model.failure_cost < 0)
        for name, others in measured.items():
            compared = compared_foresight(made.model, made.failures, others, predicts_reward)
            for head, found in compared.items():
                print(f"| {path.parent.name}: {head} | | | {name} {_figures(found)}")
        if made.failures is not None:
            _print_rates(world, made, measured)


def _figures(found: Mapping[str, Any]) -> str:
    if not found["failures"]:
        return "| | | | |"
    auc = " | ".join(f"{value:.2f}" for value in found["auc"].values())
    return f"({found['failures']} failures) | {auc} | {found['brier_skill']:.2f} |"


def _print_rates(task: Task, grounding: HistoryGrounding, measured: Mapping[str, PairedEpisodes]) -> None:
    """Print failures in 1000 steps: recorded, and expected along the same commands in the simulator."""
    print("\n| commands of | recorded | " + " | ".join(f"scatter {one}" for one in SCATTERS) + " |")
    print("|---|---|" + "---|" * len(SCATTERS))
    for name, episodes in measured.items():
        windows, rates = episodes.windows, []
        for scale in SCATTERS:
            torch.manual_seed(0)
            simulator = grounding.simulator(task, len(episodes), scatter=scale * grounding.scatter(episodes))
            simulator.start(windows.state[:, 0], torch.arange(len(episodes)), windows.goal[:, 0])
            expected = 0.0
            for action, mask in zip(windows.action.unbind(1), windows.mask.unbind(1), strict=True):
                simulator.step(action)
                risk = simulator.topple_risk()
                assert risk is not None
                expected += float((risk * mask).sum())
            rates.append(1e3 * expected / float(windows.mask.sum()))
        recorded = 1e3 * float((windows.reward[..., 1] != 0).sum() / windows.mask.sum())
        print(f"| {name} | {recorded:.2f} | " + " | ".join(f"{rate:.2f}" for rate in rates) + " |")


if __name__ == "__main__":
    typer.run(main)
