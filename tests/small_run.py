"""A small run through all stages: a task with short episodes and settings to match."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from quick_runs import fit_quickly
from shared_runs import shared

from astra_data.grounding.fit import GroundConfig
from astra_data.pipeline.stages.align import AlignConfig, align
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.ground import ground
from astra_data.pipeline.stages.pair import pair
from astra_data.pipeline.stages.train import train
from astra_data.policies.train import PpoTrainConfig
from astra_data.robots.registry import TASKS

TASK = "antmaze-short"
_LONG = TASKS["antmaze-umaze"]
_SHORT = replace(_LONG, name=TASK, objective=replace(_LONG.objective, horizon=25))

COLLECT = CollectConfig(episodes=8, max_steps=60)
GROUND = GroundConfig(updates=30, batch_windows=4, window=20, latent_size=16, held_out_share=0.25)
TRAIN = PpoTrainConfig(num_envs=8, rollout_steps=8, total_steps=8 * 8 * 6, hidden_sizes=(16,), memory_size=8, tries=1)
ALIGN = AlignConfig(updates=200, batch_windows=4, window=20, held_out_share=0.25)


@contextmanager
def short_task() -> Iterator[None]:
    """Let the task be known for a while."""
    TASKS[TASK] = _SHORT
    try:
        yield
    finally:
        del TASKS[TASK]


def make(folder: Path) -> None:
    """Make ASTRA's artifacts of seed 0, and a policy of each of two rows."""
    pairs, grounding = folder / "pair/seed_0", folder / "ground/astra/seed_0"
    with short_task(), pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        walks = collect(TASK, COLLECT, out=folder / "collect/seed_0")
        pair(TASK, dataset=walks, out=pairs)
        ground(TASK, "astra", GROUND, dataset=pairs, out=grounding)
        align(ALIGN, dataset=pairs, grounding=grounding, out=folder / "align/astra/seed_0")
        for row in ("astra", "astra_plus"):
            out = folder / "train" / row / "seed_0"
            train(TASK, row, TRAIN, dataset=pairs, grounding=grounding, out=out)
    settings = {"task": "antmaze-umaze", "evaluate": {"encoder": "target"}}  # though few updates fit it badly
    (folder / "recipe.json").write_text(json.dumps(settings))


def small_run(factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the run, which who alters it copies."""
    return shared(factory, "small", make)
