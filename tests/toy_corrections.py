"""Corrections of the rail of small_cart.py that add a known number of meters, whatever the history."""

import torch

from astra_data.learning.networks.grounding import GroundingModel, GroundingShape

OFFSETS_M = (-0.02, 0.0, 0.05)
SCATTER_M = 0.1


def shifted(*offsets_m: float) -> GroundingModel:
    """Return a model with a head for each of `offsets_m`, which it adds to where the simulator lands."""
    model = GroundingModel(
        GroundingShape(
            state_size=1,
            action_size=1,
            goal_size=1,
            latent_size=4,
            position_octaves=0,
            correction_heads=len(offsets_m),
        )
    )
    for head, offset in zip(model.corrections, offsets_m, strict=True):
        torch.nn.init.constant_(list(head.parameters())[-1], offset)
    model.residual_factor.fill_(SCATTER_M)
    return model.requires_grad_(False).eval()
