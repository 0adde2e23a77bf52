"""Gymnasium's humanoid under four joint commands: model, batched bodies, target, abstract simulators."""

from astra_data.robots.humanoid.bodies import Humanoids
from astra_data.robots.humanoid.locomotion import Locomotion
from astra_data.robots.humanoid.model import CommandRanges, humanoid_model

__all__ = ["CommandRanges", "Humanoids", "Locomotion", "humanoid_model"]
