"""LeRobot's settings of a policy that `astra-data deploy` wrote."""

from dataclasses import dataclass
from typing import NoReturn

from lerobot.configs import PreTrainedConfig

from astra_data.deployment.lerobot.files import TYPE


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class AstraDataConfig(PreTrainedConfig):  # type: ignore[misc]
    """The sizes of state, goal and command, as they lie in the policy's folder."""

    @property
    def observation_delta_indices(self) -> None:
        """None: the policy remembers by itself."""

    @property
    def action_delta_indices(self) -> None:
        """None: LeRobot does not train it."""

    @property
    def reward_delta_indices(self) -> None:
        """None, likewise."""

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("LeRobot does not train this policy: astra-data train does")

    def get_scheduler_preset(self) -> None:
        """None, likewise."""

    def validate_features(self) -> None:
        """Do nothing: the policy compares what it is shown."""
