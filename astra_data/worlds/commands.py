"""Commands in their own units, and as policies give them, ±1 along each axis; simulators driven so."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.dataset.columns import ACTION
from astra_data.dataset.versions import open_dataset
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.variation import VariedSimulator, noisy_command


class Commands(dict[str, tuple[float, float]]):
    """The least and the largest command along each of A axes, by the axes' names.

    Example:
        >>> import torch
        >>> from astra_data.worlds.commands import Commands
        >>> drive = Commands({"v": (-0.2, 1.0), "w": (-1.5, 1.5)})
        >>> drive.in_units(torch.tensor([[1.0, 0.0]]))
        tensor([[1., 0.]])
        >>> drive.normal(torch.tensor([[0.4, 1.5]]))
        tensor([[0., 1.]])
    """

    def __init__(self, bounds: Mapping[str, tuple[float, float]]) -> None:
        """Take the bounds (least, largest) of each axis, in the units of the robot's commands."""
        faults = [] if bounds else ["no axis is named"]
        wrong = {name: ends for name, ends in bounds.items() if not _is_range(ends)}
        faults += [f"{name}: expected (least, largest), got {ends!r}" for name, ends in wrong.items()]
        if faults:
            raise BadInputError(f"commands: {'; '.join(faults)}")
        super().__init__({name: (float(low), float(high)) for name, (low, high) in bounds.items()})
        low, high = np.array(list(self.values()), np.float32).T
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self.are_normal = {*self.values()} == {(-1.0, 1.0)}  # in their own units already

    @classmethod
    def recorded(cls, dataset: str | Path) -> Self:
        """Return the range of the commands in a dataset, named as every command takes it, as the bounds."""
        source = open_dataset(dataset)
        statistics = source.statistics()
        if ACTION not in statistics:
            raise BadInputError(f"commands: {source.reference} has no column {ACTION}: give their bounds")
        ends = np.array([statistics[ACTION][end] for end in ("min", "max")], float).T.tolist()
        names = next(column for column in source.schema if column.name == ACTION).labels
        if still := [name for name, (low, high) in zip(names, ends, strict=True) if low == high]:
            raise BadInputError(f"commands: {', '.join(still)} never changes in {source.reference}: give the bounds")
        return cls(dict(zip(names, ends, strict=True)))

    def in_units(self, action: Tensor, *, is_recorded: bool = False) -> Tensor:
        """Return actions of ±1 (..., A) in the units of the commands: clipped first, unless they were recorded."""
        given = action if is_recorded else action.clamp(-1.0, 1.0)
        if self.are_normal:
            return given
        middle, half = map(torch.from_numpy, (self._middle, self._half))
        return middle.to(action.device) + half.to(action.device) * given

    def normal(self, command: Tensor) -> Tensor:
        """Return commands (..., A) as multiples of ±1; those beyond the bounds are beyond ±1."""
        if self.are_normal:
            return command
        middle, half = map(torch.from_numpy, (self._middle, self._half))
        return (command - middle.to(command.device)) / half.to(command.device)


def _is_range(ends: Iterable[float]) -> bool:
    """Return whether `ends` are two numbers, of which float32 knows the second as the larger one."""
    with suppress(TypeError, ValueError, OverflowError), np.errstate(over="ignore", invalid="ignore"):
        low, high = (np.float32(float(end)) for end in ends)
        return bool(0 < high - low < np.inf)
    return False


class DrivenSimulator:
    """B abstract simulators of a task, given actions of ±1 and states on any device; what they lack does nothing."""

    def __init__(self, simulator: AbstractSimulator, commands: Commands, device: str) -> None:
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
        """Apply `action` (B, A) of ±1, of recorded commands maybe beyond; return the new states (B, X)."""
        landed = self.simulator.step(self._commands.in_units(action, is_recorded=True).to(self._there))
        return landed.to(self._device, copy=True)

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


def innermost(simulator: Any) -> Any:  # noqa: ANN401 - any object
    """Return the simulator that `simulator` drives or varies, itself if it is none of others."""
    while isinstance(simulator, DrivenSimulator | VariedSimulator):
        simulator = simulator.simulator
    return simulator
