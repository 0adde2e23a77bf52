"""Any abstract simulator, driven as policies drive it: by commands of ±1, on any device."""

from collections.abc import Mapping

import torch
from torch import Tensor

from astra_data.worlds.commands import Commands
from astra_data.worlds.protocols import SteppedSimulator, keep_clear
from astra_data.worlds.variation import VariedSimulator, noisy_command


class DrivenSimulator:
    """B abstract simulators of a task, given actions of ±1.

    States may be corrected to anywhere, and no parameter can be set, unless the simulator says otherwise (see
    `PlacedSimulator` and `VariableSimulator`).

    Attributes:
        simulator: the simulator itself, whose commands have units.
    """

    def __init__(self, simulator: SteppedSimulator, commands: Commands, device: str) -> None:
        """Drive `simulator` within the bounds of `commands`; states are given and taken on `device`."""
        self.simulator = simulator
        self._commands, self._device = commands, device
        self._there = simulator.state.device
        self._free = torch.zeros(len(simulator.state), dtype=torch.bool, device=device)

    @property
    def state(self) -> Tensor:
        """A copy of the present states, (B, X) float32."""
        return self.simulator.state.to(self._device, copy=True)

    @property
    def parameters(self) -> Mapping[str, float]:
        """What a dataset paired with the simulator records about it."""
        return dict(getattr(self.simulator, "parameters", {}))

    @property
    def blocked(self) -> Tensor:
        """Which states (B,) were stopped at the edge of the free space in the last step, bool."""
        return getattr(self.simulator, "blocked", self._free).to(self._device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state.to(self._there), None if rows is None else rows.to(self._there))

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A) of ±1; return the new states (B, X)."""
        landed = self.simulator.step(self._commands.in_units(action).to(self._there))
        return landed.to(self._device, copy=True)

    def keep_clear(self, distance_m: float) -> None:
        """Let corrections end no closer to walls than `distance_m`, where there are walls."""
        keep_clear(self.simulator, distance_m)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` as far toward `landed`, both (B, X), as there is room; return where (B, X)."""
        if hasattr(self.simulator, "settle"):
            there: Tensor = self.simulator.settle(before.to(self._there), landed.to(self._there))
            return there.to(self._device, copy=True)
        self.reset_to(landed)
        return self.state

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use `parameters` by name, (B, 1) each, from the next step on; those without effect are ignored."""
        if hasattr(self.simulator, "vary"):
            self.simulator.vary({name: values.to(self._there) for name, values in parameters.items()})


class VariedCommands(VariedSimulator):
    """B simulators of any kind, each with the parameters of a `CommandVariation`."""

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A), longer or shorter by an error of the row and with noise, clipped to ±1."""
        parameters = self.by_name()
        scaled = action.clamp(-1.0, 1.0) * (1.0 + parameters["action_scale"])
        return self.simulator.step(noisy_command(scaled, parameters["action_noise"]))
