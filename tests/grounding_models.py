"""Small grounding models, members and failure models that were never fitted, and where robots stand."""

import torch

from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]
GOAL = torch.tensor([[-4.0, -4.0], [4.0, 4.0], [0.0, 4.0]])
HERE = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])


def model(heads: int = 1, corrects_reward: bool = False) -> GroundingModel:
    torch.manual_seed(0)
    made = GroundingModel(
        GroundingShape(4, 2, 2, latent_size=8, correction_heads=heads, corrects_reward=corrects_reward)
    )
    with torch.no_grad():
        for head in made.corrections:
            list(head.parameters())[-2].normal_(std=0.05)
    return made.requires_grad_(False)


def members(count: int = 2) -> tuple[GroundingModel, ...]:
    """Models that differ from each other and from `model()`, in what they expect of states, too."""
    made = []
    for number in range(count):
        one = model()
        for parameter in one.parameters():
            parameter.mul_(1.1 + 0.1 * number)
        one.state_mean.fill_(0.1 * (1 + number))
        made.append(one)
    return tuple(made)


def divided(used: GroundingModel, others: tuple[GroundingModel, ...], count: int = 5) -> GroundedSimulator:
    one = GroundedSimulator(PointMass(U_MAZE, count, timestep_s=0.05), used, members=others)
    one.start(HERE.expand(count, 4), torch.arange(count), GOAL[0].expand(count, 2))
    return one


def failure_model() -> FailureModel:
    torch.manual_seed(3)
    return FailureModel(FailureShape(4, 2, 0.05, members=2)).requires_grad_(False).eval()
