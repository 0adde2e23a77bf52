"""A simulated stand-in for the NAO V6: body, leg kinematics, walk, batched robots, tasks."""

from astra_data.robots.nao.body import nao_model
from astra_data.robots.nao.robot import BatchedNao, Senses
from astra_data.robots.nao.steps import Gait, StepPlanner, WalkLimits
from astra_data.robots.nao.traits import IDENTICAL, Traits, TraitSpread
from astra_data.robots.nao.walk import WalkEngine, WalkStyle

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
