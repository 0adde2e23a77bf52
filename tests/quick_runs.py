"""Runs in the test's own process, and fits of a few updates, where what they learn does not matter."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from astra_data.grounding.descent import DescentConfig
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.plan import plan, selected, stages_until


def small_tables(*, held_out_share: float, episodes: int, train: str = "") -> str:
    """Return the tables of a recipe whose fits and trainings take a moment; `train` is added to `[train]`."""
    return f"""
[ground]
updates = 2
batch_windows = 4
window = 5
latent_size = 4
held_out_share = {held_out_share}
[train]
num_envs = 4
rollout_steps = 8
total_steps = 64
hidden_sizes = [8]
memory_size = 4
tries = 1
{train}
[align]
updates = 2
batch_windows = 4
window = 5
[evaluate]
episodes = {episodes}
"""


def run_here(path: Path, until: str | None = None, device: str = "cpu", seeds: Sequence[int] = ()) -> Path:
    """Run a recipe, by default all of its seeds, in this process, to `runs` beside it; return its folder.

    A process of its own takes seconds to load what this one has loaded.
    """
    experiment, stages = load_experiment(path, path.parent / "runs"), stages_until(until)
    experiment.folder.mkdir(parents=True)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    part = selected(experiment.recipe, seeds=seeds)
    for item in plan(experiment.recipe, path, experiment.folder, part, device=device):
        if item.stage in stages:
            item.call()
    return experiment.folder


def fit_quickly(patch: pytest.MonkeyPatch) -> None:
    """Fit failure and scatter models in a few updates: they foresee nothing."""
    for model in ("failures", "history"):
        patch.setattr(f"astra_data.grounding.{model}._DESCENT", DescentConfig(updates=3, learning_rate=1e-3))
