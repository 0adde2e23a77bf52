"""How well failures are foreseen on fresh episodes, by how many a failure model has seen; print Markdown.

    python tools/check_failures.py antmaze-long runs/x --fresh 3 --fresh 4 --episodes 50
    python tools/check_failures.py cart.py:TASK runs/x --row astra --fresh 1
    python tools/check_failures.py cart.py:TASK runs/x --within 20 --within 2

Failure models are fitted to a seed's paired episodes, as they are replayed in its grounding, and measured on
those of other seeds, replayed there as well. So are its own failure model, topple head and R_pred; and the
recorded commands are replayed as a whole, where the model is to expect as many failures as were recorded.
With `--within`, failure models of so many steps are cross-fitted to the seed's own episodes instead, and it
is told how well they know the very step of a failure.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from door import run_tool

from astra_data.grounding.calibration import folds
from astra_data.grounding.failures import (
    AHEAD_STEPS,
    compared_foresight,
    failing,
    fit_failures,
    foresight,
    replayed_inputs,
    tells_failures,
)
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.fit import HistoryFit
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import grounded_as, method_named
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task


def main(
    task: str,
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    fresh: Annotated[list[int] | None, typer.Option(help="Seeds whose episodes to measure on.")] = None,
    row: Annotated[str, typer.Option(help="Whose grounding.")] = "nas",
    seed: Annotated[int, typer.Option(help="Of the grounding, and of the episodes to fit to.")] = 0,
    episodes: Annotated[list[int] | None, typer.Option(help="First episodes to fit to, besides all.")] = None,
    members: Annotated[int, typer.Option(help="Networks of each failure model.")] = 5,
    ahead: Annotated[list[str] | None, typer.Option(help='Steps before a failure, such as "1-5".')] = None,
    within: Annotated[list[int] | None, typer.Option(help="Steps of failure models to compare.")] = None,
) -> None:
    """Print a line for each model and dataset."""
    world = task_named(task)
    measured = {one: PairedEpisodes.load(run / "pair" / f"seed_{one}") for one in fresh or ()}
    windows = [_window(one) for one in ahead or ()] or list(AHEAD_STEPS)
    grounding = load_grounding(run / "ground" / grounded_as(row) / f"seed_{seed}" / GROUNDING)
    if not isinstance(grounding, HistoryGrounding):
        raise typer.BadParameter(f"{row} has no history grounding")
    whole = PairedEpisodes.load(run / "pair" / f"seed_{seed}")
    if within:
        _print_likelihoods(world, grounding, whole, members, within)
        return
    titles = " | ".join(f"{first}-{last}" for first, last in windows)
    print(f"| fitted to | failures | on seed | {titles} | Brier skill |")
    print("|---|---|---|" + "---|" * (len(windows) + 1))
    for count in [*(episodes or []), len(whole)]:
        part = whole.select(torch.arange(count))
        if not tells_failures(world, part):
            continue
        fitted = fit_failures(world, grounding, part, members, seed=0)
        failures = int(part.windows.fails_soon.any(1).sum())
        for name, others in measured.items():
            said = fitted.probability(replayed_inputs(world, grounding, fitted, others))
            found = foresight(said, failing(world, others, fitted.shape.risk_steps), windows)
            print(f"| {count} episodes | {failures} | {name} {_figures(found, len(windows))}")
    fit = method_named(row).fit
    predicts_reward = isinstance(fit, HistoryFit) and fit.reward
    for name, others in measured.items():
        compared = compared_foresight(world, grounding, others, predicts_reward, windows)
        for head, found in compared.items():
            print(f"| {row}: {head} | | {name} {_figures(found, len(windows))}")
    if grounding.failures is not None:
        _print_rates(world, grounding, measured)


def _window(told: str) -> tuple[int, int]:
    first, _, last = told.partition("-")
    if not (first.isdecimal() and last.isdecimal() and 0 < int(first) <= int(last)):
        raise typer.BadParameter(f'--ahead: expected first and last steps such as "1-5", got {told!r}')
    return int(first), int(last)


def _print_likelihoods(
    task: Task, grounding: HistoryGrounding, whole: PairedEpisodes, members: int, within: list[int]
) -> None:
    """Print the log-likelihood of when failures came, above that of a constant rate."""
    print("| within | failures | nats a failure above a constant rate | expected |\n|---|---|---|---|")
    for steps in within:
        episodes = failing(task, whole, steps)
        mask, fails = episodes.windows.mask, episodes.windows.fails_soon.any(1)
        if fails.sum() < 2:
            raise typer.BadParameter(f"expected two episodes that fail to cross-fit, got {int(fails.sum())}")
        hazard = torch.zeros_like(mask)
        torch.manual_seed(0)
        for fold in folds(fails, episodes.recordings):
            fitted_to, fresh = (episodes.select(part.nonzero().squeeze(1)) for part in (~fold, fold))
            model = fit_failures(task, grounding, fitted_to, members, 0, steps)
            hazard[fold] = model.hazard(model.probability(replayed_inputs(task, grounding, model, fresh)))
        here = fails[:, None] & (failing(task, whole, 1).windows.fails_soon > 0)
        count, steps_in_all = float(fails.sum()), float(mask.sum())
        rate = torch.full_like(mask, count / steps_in_all)
        known, usual = (
            float((torch.where(here, one.log(), torch.log1p(-one)) * mask).sum())
            for one in (hazard.clamp(1e-7, 1 - 1e-7), rate)
        )
        print(
            f"| {steps} | {count:.0f} | {(known - usual) / count:.2f} | {float((hazard * mask).sum()):.1f} |"
        )


def _figures(found: Mapping[str, Any], windows: int) -> str:
    if not found["failures"]:
        return "| " * (windows + 2) + "|"
    told = [
        "-" if value is None else f"{value:.2f}" for value in (*found["auc"].values(), found["brier_skill"])
    ]
    return f"({found['failures']} failures) | {' | '.join(told)} |"


@torch.no_grad()
def _print_rates(task: Task, grounding: HistoryGrounding, measured: Mapping[int, PairedEpisodes]) -> None:
    """Print failures in 1000 steps: recorded, and expected along the same commands in the simulator."""
    print("\n| commands of seed | recorded | expected |\n|---|---|---|")
    for name, episodes in measured.items():
        windows, expected = episodes.windows, 0.0
        simulator = grounding.foreseeing(task.objective).simulator(task, len(episodes))
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
