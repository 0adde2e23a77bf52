"""What a method is: which parts of the pipeline it uses, and how."""

from dataclasses import dataclass

from astra_data.models.grounding import LossWeights
from astra_data.world import RewardSource


@dataclass(frozen=True)
class Method:
    """One row of the paper's tables.

    Attributes:
        name: in recipes and folders. title: in tables and figures.
        loss_weights: of the grounding; None where the simulator stays raw.
        reward: where the policy's reward comes from, as the method is published.
        aligns: whether a target encoder is fitted for deployment.
        trains: whether there is a policy to train.
    """

    name: str
    title: str
    loss_weights: LossWeights | None = None
    reward: RewardSource = "abstract"
    aligns: bool = False
    trains: bool = True

    @property
    def grounds(self) -> bool:
        """Whether the simulator is grounded."""
        return self.loss_weights is not None
