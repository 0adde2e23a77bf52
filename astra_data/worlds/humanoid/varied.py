"""The humanoid's simulators with parameters that differ from row to row."""

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from astra_data.worlds.protocols import PlacedSimulator
from astra_data.worlds.variation import Variation, noisy_command


class HumanoidSimulator(PlacedSimulator, Protocol):
    """B humanoids whose joints and control steps can be set."""

    def vary(self, friction: Tensor, timestep_scale: Tensor) -> None:
        """Set the factors (B,) on the damping of the joints, and on the control step."""
        ...


class VariedHumanoid:
    """B of a humanoid's simulators, each with its own parameters (see `JointVariation`).

    A command gets noise, is cut off at ±1 and scaled; what then is beyond ±1, the simulator cuts off as ever.
    Noise is drawn from torch's global generator. What `state` shows is the true state, scaled: rewards are
    paid and falls are told by that, and by steps of the plain length. With the plain parameters it is the
    plain simulator.

    Attributes:
        variation: the ranges of the parameters. parameters: (B, P), in the order of its `names`.
    """

    def __init__(
        self,
        make_simulator: Callable[..., HumanoidSimulator],
        num_envs: int,
        variation: Variation,
        *,
        device: str = "cpu",
    ) -> None:
        """Build B of what `make_simulator` builds."""
        self.simulator = make_simulator(num_envs, device=device)
        self.variation = variation
        self.parameters = variation.draw(num_envs, device)

    @property
    def _scale(self) -> Tensor:
        """What is shown, in shares of what is so, (B, 1)."""
        return self.variation.by_name(self.parameters)["observation_scale"].unsqueeze(-1)

    @property
    def state(self) -> Tensor:
        """What is shown, (B, X)."""
        return self._scale * self.true_state

    @property
    def true_state(self) -> Tensor:
        """What is so, (B, X)."""
        return self.simulator.state

    @true_state.setter
    def true_state(self, state: Tensor) -> None:
        self.simulator.reset_to(state)

    @property
    def blocked(self) -> Tensor:
        """Which were stopped at the edge of the free space: none, (B,) bool."""
        return self.simulator.blocked

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the true states in `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state, rows)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to where `landed` is shown, both (B, X); return what is shown (B, X)."""
        self.simulator.settle(before / self._scale, landed / self._scale)
        return self.state

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, A); return what is shown of the new state (B, X)."""
        of = self.variation.by_name(self.parameters)
        self.simulator.vary(of["friction"], of["timestep_scale"])
        self.simulator.step((1.0 + of["action_scale"]).unsqueeze(-1) * noisy_command(of, action))
        return self.state
