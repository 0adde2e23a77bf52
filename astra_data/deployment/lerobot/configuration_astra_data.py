"""LeRobot's settings of a policy that `astra-data deploy` wrote."""

from dataclasses import dataclass
from typing import NoReturn

from lerobot.configs import PreTrainedConfig

from astra_data.deployment.folder import TYPE


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class AstraDataConfig(PreTrainedConfig):  # type: ignore[misc]
    """The sizes of state, goal and command, as they lie in the policy's folder; the policy remembers by itself."""

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse with a NotImplementedError."""
        raise NotImplementedError("LeRobot does not train this policy: astra-data train does")

    def get_scheduler_preset(self) -> None:
        """Return None."""

    def validate_features(self) -> None:
        """Do nothing: the policy compares what it is shown."""
