"""Gymnasium's humanoid under four joint commands: its model, its bodies at once, what is abstracted of it."""

from astra_data.humanoid.bodies import Humanoids
from astra_data.humanoid.locomotion import Locomotion
from astra_data.humanoid.model import CommandRanges, humanoid_model

__all__ = ["CommandRanges", "Humanoids", "Locomotion", "humanoid_model"]
