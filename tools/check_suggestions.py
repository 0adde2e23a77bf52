"""Do suggested episodes teach a grounding more than random ones? Prints Markdown.

    uv run python tools/check_suggestions.py cart runs/suggest_cart
    uv run python tools/check_suggestions.py maze runs/suggest_maze

For each seed: a few random episodes, a grounding with members, what these suggest, and as many steps more of
random commands; a grounding of each union, and how far it drifts from fresh episodes of random commands and
of `stress`. Goes on where it was interrupted.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
from door import run_tool
from scipy import stats

from astra_data.core.naming import seed_folder
from astra_data.core.progress import silent
from astra_data.core.seeding import derive
from astra_data.dataset.edit import delete, merge
from astra_data.dataset.reader import Dataset
from astra_data.grounding.committee import Committee
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.grounding.fit import GroundConfig
from astra_data.grounding.open_loop_error import gap_report
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.reports.formatting import interval, table
from astra_data.stages.collect import CollectConfig, collect
from astra_data.stages.ground import ground
from astra_data.stages.pair import pair
from astra_data.training.proposals import SuggestConfig, suggested
from astra_data.worlds.registry import task_named

ARMS = ("suggested", "random")
FRESH_SEED = 10_000
"""Of the fresh episodes, which all seeds share."""


@dataclass(frozen=True)
class Setting:
    """A task, and how much of what is collected and fitted.

    Attributes:
        task: its name. collect: of the first episodes; more are like them.
        more: episodes suggested. fresh: episodes to measure on, of each behavior.
        ground: of the members; the groundings that are compared have none.
        quantity: what is measured of the gap report.
    """

    task: str
    collect: dict[str, Any]
    more: int
    fresh: int
    ground: dict[str, Any]
    quantity: Sequence[str]


SETTINGS = {
    "cart": Setting(
        task=f"{Path(__file__).parents[1] / 'recipes/examples/cart/robot.py'}:TASK",
        collect={"episodes": 10, "max_steps": 150, "start": "task", "hold_s": (0.1, 2.0)},
        more=10,
        fresh=100,
        ground={
            **{"updates": 500, "batch_windows": 32, "window": 20, "latent_size": 32},
            **{"held_out_share": 0.2, "members": 4, "failure_members": 5},
        },
        quantity=("x", "y"),
    ),
    "maze": Setting(
        task="antmaze-long",
        collect={"episodes": 20, "max_steps": 300},
        more=20,
        fresh=60,
        ground={
            **{"updates": 200, "batch_windows": 32, "window": 40, "latent_size": 32},
            **{"members": 4, "failure_members": 5, "recorded_clearance": True},
        },
        quantity=("position_m",),
    ),
}


def main(
    which: Annotated[str, typer.Argument(help="cart or maze.")],
    folder: Path,
    seed: Annotated[list[int] | None, typer.Option(help="By default 1 to 5.")] = None,
) -> None:
    """Run the study in `folder`."""
    if which not in SETTINGS:
        raise typer.BadParameter(f"expected {' or '.join(SETTINGS)}, got {which!r}")
    setting, found = SETTINGS[which], {}
    torch.set_num_threads(1)
    for one in seed or range(1, 6):
        found[one] = measured(setting, folder, one)
        print(f"seed {one}: steps {found[one]['steps']}, falls {found[one]['falls']}", flush=True)
        for fresh in ("random", "stress"):
            print(f"  {fresh}: {found[one][fresh]}", flush=True)
    for fresh in ("random", "stress"):
        print(f"\nfresh episodes: {fresh}\n\n{compared(list(found.values()), fresh)}", flush=True)
        ranks = [foreseen(setting, folder, one, fresh) for one in found]
        print(f"\nrank correlation of information and error: {', '.join(f'{rank:.2f}' for rank in ranks)}")


def compared(found: Sequence[dict[str, Any]], fresh: str) -> str:
    """Return mean errors by horizon, and their ratios with 95 % t intervals over logarithms, in Markdown."""
    lines = []
    for at, horizon in enumerate(found[0]["horizons"]):
        errors = {arm: np.array([one[fresh][arm][at] for one in found]) for arm in ("before", *ARMS)}
        logs = np.log(errors["suggested"] / errors["random"])
        half = (
            stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
            if len(logs) > 1
            else 0
        )
        value, low, high = (math.exp(logs.mean() + off) for off in (0.0, -half, half))
        means = (f"{values.mean():.4f}" for values in errors.values())
        lines.append([f"{horizon}", *means, interval(value, low, high)])
    return table(["steps", "before", *ARMS, "suggested / random [95 %]"], lines)


@torch.no_grad()
def foreseen(setting: Setting, folder: Path, seed: int, fresh: str) -> float:
    """Return Spearman's correlation over fresh steps: what one would teach, and how wrong its prediction is.

    The latter is the distance of the committee's mean from the recorded next state, in units of the scatter.
    """
    made = load_grounding(folder / seed_folder(seed) / "before" / GROUNDING)
    committee = Committee.of(task_named(setting.task), [made])
    pairs = PairedEpisodes.load(folder / f"fresh_{fresh}_pairs")
    windows, predictions = pairs.windows, []
    for model in committee.models:
        latent, _ = model.encode(windows)
        predictions.append(model.ensemble_predictions(latent, windows.action, windows.simulated_next))
    asked = torch.cat(predictions)
    white = committee.whitened(pairs.steps(windows.next_state - asked.mean(0)))
    return float(stats.spearmanr(pairs.steps(committee.information(asked)), white.norm(dim=-1)).statistic)


def measured(setting: Setting, folder: Path, seed: int) -> dict[str, Any]:
    """Make all of a seed; return steps, falls, and errors by fresh behavior, arm and horizon."""
    home = folder / seed_folder(seed)
    result = home / "result.json"
    if result.is_file():
        kept: dict[str, Any] = json.loads(result.read_text())
        return kept
    task = task_named(setting.task)
    first = collected(setting, home / "first", seed)
    before = grounded(setting, [first], home, "before", seed)
    made = load_grounding(home / "before" / GROUNDING)
    usual = {key: first_of(setting)[key] for key in ("max_steps", "start", "hold_s")}
    config = SuggestConfig(**usual, episodes=setting.more)
    plan = home / "plan.json"
    if not plan.is_file():
        found = suggested(task, Committee.of(task, [made]), config, seed=seed)
        plan.write_text(found.plan.model_dump_json())
    more = {
        "suggested": collected(
            setting, home / "suggested_more", seed, behavior="planned", plan=str(plan), episodes=setting.more
        )
    }
    steps = int(more["suggested"].lengths.sum())
    pool = collected(setting, home / "random_pool", derive(seed, "more"), episodes=3 * setting.more)
    count = int(np.abs(pool.lengths.cumsum() - steps).argmin()) + 1
    drawn = home / "random_more"
    if not drawn.is_dir():
        drawn = delete(pool, pool.uids[count:].tolist(), out=drawn)
    more["random"] = Dataset.open(drawn)
    groundings = {"before": before} | {
        arm: grounded(setting, [first, more[arm]], home, arm, seed, members=0, failure_members=0)
        for arm in ARMS
    }
    told: dict[str, Any] = {
        "steps": {"first": int(first.lengths.sum())} | {a: int(d.lengths.sum()) for a, d in more.items()},
        "falls": {
            a: int(np.sum(np.array(d.metadata["failed"]))) for a, d in ({"first": first} | more).items()
        },
    }
    for fresh in ("random", "stress"):
        source = collected(
            setting, folder / f"fresh_{fresh}", FRESH_SEED, behavior=fresh, episodes=setting.fresh
        )
        pairs = PairedEpisodes.load(paired(setting, source, folder / f"fresh_{fresh}_pairs"))
        reports = {arm: gap_report(task, one, pairs, seed=0) for arm, one in groundings.items()}
        told["horizons"] = reports["before"]["horizons"]
        told[fresh] = {
            arm: np.linalg.norm([report["grounded"][of]["mean"] for of in setting.quantity], axis=0).tolist()
            for arm, report in reports.items()
        }
    result.write_text(json.dumps(told, indent=1))
    return told


def first_of(setting: Setting) -> dict[str, Any]:
    """Return the settings of the first episodes, whole."""
    return CollectConfig(**setting.collect).model_dump()


def collected(
    setting: Setting,
    out: Path,
    seed: int,
    *,
    behavior: Literal["random", "stress", "planned"] = "random",
    **more: Any,  # noqa: ANN401 - of CollectConfig
) -> Dataset:
    """Return episodes, which are recorded unless they are there."""
    if not out.is_dir():
        collect(
            setting.task,
            CollectConfig(**setting.collect | {"behavior": behavior} | more),
            seed=seed,
            out=out,
            progress=silent,
            num_threads=1,
        )
    return Dataset.open(out)


def paired(setting: Setting, source: Dataset, out: Path) -> Path:
    """Return the folder of the pairs of `source`."""
    return out if out.is_dir() else pair(setting.task, dataset=source.root, out=out)


def grounded(
    setting: Setting, sources: Sequence[Dataset], home: Path, name: str, seed: int, **changed: int
) -> Any:  # noqa: ANN401 - any grounding
    """Return a grounding by NAS of all episodes of `sources`."""
    out = home / name
    if not out.is_dir():
        union = home / f"{name}_union"
        if not union.is_dir():
            union = merge(sources, new_uids=True, out=union) if len(sources) > 1 else sources[0].root
        pairs = paired(setting, Dataset.open(union), home / f"{name}_pairs")
        config = GroundConfig(**setting.ground | changed)
        ground(setting.task, "nas", config, dataset=pairs, seed=seed, out=out)
    return load_grounding(out / GROUNDING)


if __name__ == "__main__":
    run_tool(main)
