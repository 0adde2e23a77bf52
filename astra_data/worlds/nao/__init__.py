"""A simulated stand-in for the NAO V6: body, leg kinematics, walk, batched robots, tasks."""

from astra_data.worlds.nao.body import nao_model
from astra_data.worlds.nao.robot import BatchedNao, Senses
from astra_data.worlds.nao.steps import Gait, StepPlanner, WalkLimits
from astra_data.worlds.nao.traits import IDENTICAL, Traits, TraitSpread
from astra_data.worlds.nao.walk import WalkEngine, WalkStyle

__all__ = [
    "IDENTICAL",
    "BatchedNao",
    "Gait",
    "Senses",
    "StepPlanner",
    "TraitSpread",
    "Traits",
    "WalkEngine",
    "WalkLimits",
    "WalkStyle",
    "nao_model",
]
