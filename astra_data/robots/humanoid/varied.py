"""The humanoid's simulators with parameters that differ from row to row."""

from torch import Tensor

from astra_data.worlds.variation import VariedSimulator, noisy_command


class VariedHumanoid(VariedSimulator):
    """B of one of the humanoid's simulators, each with the parameters of a `JointVariation`.

    A command gets noise, is clipped to ±1 and scaled; the simulator clips the result again. Sensors show the
    true state, scaled; rewards and falls are those of the observed state and of steps of the plain length.
    """

    @property
    def _scale(self) -> Tensor:
        return self.by_name()["observation_scale"]

    @property
    def state(self) -> Tensor:
        """The observed states, (B, X) float32."""
        return self._scale * self.true_state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to where `landed` is observed, both (B, X); return the observed states."""
        self.simulator.settle(before / self._scale, landed / self._scale)
        return self.state

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, A); return the observed states (B, X)."""
        parameters = self.by_name()
        self.simulator.vary(parameters)
        command = noisy_command(action, parameters["action_noise"])
        self.simulator.step((1.0 + parameters["action_scale"]) * command)
        return self.state
