"""A small run through all stages: a task with short episodes and settings to match."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from astra_data.grounding.fit import GroundConfig
from astra_data.pipeline.stages.align import AlignConfig
from astra_data.pipeline.stages.collect import CollectConfig
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
