"""Small grounding models and failure models that were never fitted, and where robots stand."""

import torch

from astra_data.grounding.failures import FailureModel, FailureShape
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
GOAL = torch.tensor([[-4.0, -4.0], [4.0, 4.0], [0.0, 4.0]])
HERE = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])


def model(corrects_reward: bool = False) -> GroundingModel:
    torch.manual_seed(0)
    made = GroundingModel(GroundingShape(4, 2, 2, latent_size=8, corrects_reward=corrects_reward))
    list(made.correction.parameters())[-2].data.normal_(std=0.05)
    return made.requires_grad_(False)


def failure_model(latent_size: int = 0) -> FailureModel:
    torch.manual_seed(3)
    shape = FailureShape(4, 2, 0.05, members=2, latent_size=latent_size)
    return FailureModel(shape).requires_grad_(False).eval()
