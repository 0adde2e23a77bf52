"""What a method is: which parts of the pipeline it uses, and how."""

from dataclasses import dataclass

from astra_data.grounding.fit import Fit, HistoryFit
from astra_data.training.simulator_env import RewardSource
from astra_data.training.train import InSimulator, Learn
from astra_data.training.train_in_target import InTarget

IN_RAW_SIMULATOR = InSimulator()


@dataclass(frozen=True)
class Method:
    """One row of the paper's tables.

    Attributes:
        name: in recipes and folders. title: in tables and figures.
        fit: what it learns about the simulator from pairs; None where the simulator stays raw.
        learn: how it learns its policy; None where there is none to learn.
        aligns: whether a target encoder is fitted for deployment.
        initial: the method whose policy its own goes on from, if any.
        grounded_as: the method whose grounding and alignment it uses; its own where empty.
        table: the recipe's table with its settings, if it has any; that of its own name where empty.
        planar: whether it is for tasks in a maze alone.
    """

    name: str
    title: str
    fit: Fit | None = None
    learn: Learn | None = IN_RAW_SIMULATOR
    aligns: bool = False
    initial: str | None = None
    grounded_as: str = ""
    table: str = ""
    planar: bool = False

    @property
    def grounds(self) -> bool:
        """Whether something is fitted to pairs."""
        return self.fit is not None

    @property
    def trains(self) -> bool:
        """Whether there is a policy to train."""
        return self.learn is not None

    @property
    def in_simulator(self) -> bool:
        """Whether its policy is trained in the abstract simulator, so that the cures of `[plus]` apply."""
        return isinstance(self.learn, InSimulator)

    @property
    def steps_target(self) -> bool:
        """Whether its policy is trained in the target itself."""
        return isinstance(self.learn, InTarget)

    def learns_from(self, reward: RewardSource | None) -> bool:
        """Tell whether it can be trained with `reward`: "predicted" needs a grounding that predicts it."""
        predicts = isinstance(self.fit, HistoryFit) and self.fit.reward
        return reward != "predicted" or predicts or not self.in_simulator
