"""Robot trajectories into LeRobot datasets, and those into policies that work on the robot.

Every name below is loaded when it is first used, so that reading a dataset needs neither torch nor MuJoCo.

data        Dataset  DatasetWriter  StagedWriter  Episode  Column  Frames
edits       augment  label  pair  subset  merge
sharing     push  pull
worlds      Task  Objective  Simulator  TASKS
learning    METHODS  collect  ground  train  align  evaluate  load_policy
all of it   run
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from astra_data.core.errors import missing_extra

if TYPE_CHECKING:
    from astra_data.dataset.columns import Column as Column
    from astra_data.dataset.columns import Episode as Episode
    from astra_data.dataset.edit import merge as merge
    from astra_data.dataset.edit import subset as subset
    from astra_data.dataset.frames import Frames as Frames
    from astra_data.dataset.reader import Dataset as Dataset
    from astra_data.dataset.writer import DatasetWriter as DatasetWriter
    from astra_data.dataset.writer import StagedWriter as StagedWriter
    from astra_data.io.hub.sharing import pull as pull
    from astra_data.io.hub.sharing import push as push
    from astra_data.methods import METHODS as METHODS
    from astra_data.pipeline.run import run as run
    from astra_data.pipeline.stages.align import align as align
    from astra_data.pipeline.stages.augment import augment as augment
    from astra_data.pipeline.stages.collect import collect as collect
    from astra_data.pipeline.stages.evaluate import evaluate as evaluate
    from astra_data.pipeline.stages.ground import ground as ground
    from astra_data.pipeline.stages.label import label as label
    from astra_data.pipeline.stages.pair import pair as pair
    from astra_data.pipeline.stages.train import train as train
    from astra_data.pipeline.trained_policy import load_policy as load_policy
    from astra_data.robots.registry import TASKS as TASKS
    from astra_data.worlds.objective import Objective as Objective
    from astra_data.worlds.protocols import Simulator as Simulator
    from astra_data.worlds.task import Task as Task

_NAMES = {
    "dataset.columns": ("Column", "Episode"),
    "dataset.edit": ("merge", "subset"),
    "dataset.frames": ("Frames",),
    "dataset.reader": ("Dataset",),
    "dataset.writer": ("DatasetWriter", "StagedWriter"),
    "io.hub.sharing": ("pull", "push"),
    "methods": ("METHODS",),
    "pipeline.run": ("run",),
    "pipeline.trained_policy": ("load_policy",),
    "robots.registry": ("TASKS",),
    "worlds.objective": ("Objective",),
    "worlds.protocols": ("Simulator",),
    "worlds.task": ("Task",),
}
_STAGES = ("align", "augment", "collect", "evaluate", "ground", "label", "pair", "train")
_MODULES = {name: module for module, names in _NAMES.items() for name in names}
_MODULES |= {stage: f"pipeline.stages.{stage}" for stage in _STAGES}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:  # noqa: ANN401 - whatever is named
    if name not in _MODULES:
        raise AttributeError(f"module 'astra_data' has no attribute '{name}'; it has {', '.join(__all__)}")
    try:
        module = import_module(f"astra_data.{_MODULES[name]}")
    except ModuleNotFoundError as error:
        if (reported := missing_extra(error)) is None:
            raise
        raise reported from None
    globals()[name] = value = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return __all__
