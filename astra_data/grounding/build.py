"""The simulators of a task: raw, scattered, varied, or as a grounding makes it."""

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.grounding.grounding_file import Grounding
from astra_data.grounding.residual_simulator import AugmentedSimulator
from astra_data.grounding.simulator import GroundedSimulator
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.paired_windows import Windows
from astra_data.learning.networks.residual import ResidualModel
from astra_data.worlds.protocols import PlacedSimulator, RememberingSimulator
from astra_data.worlds.scattered import RandomizedSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation, VariedSimulator

Simulator = PlacedSimulator | RandomizedSimulator | GroundedSimulator | AugmentedSimulator
"""As it is, or in one of the wrappers."""


def simulator_of(
    task: Task,
    grounding: Grounding | None,
    num_envs: int,
    device: str,
    *,
    variation: Variation | None = None,
    scatter: Tensor | None = None,
) -> Simulator:
    """Build `num_envs` abstract simulators.

    Args:
        task: whose.
        grounding: what a method learned about the simulator, if anything.
        num_envs: B.
        device: torch device.
        variation: of its parameters from episode to episode, unless the grounding is one.
        scatter: factor (X, X) of noise that is added after each step.
    """
    if isinstance(grounding, Variation):
        variation = grounding
    inner: PlacedSimulator
    if variation is None:
        inner = task.simulator(num_envs, device)
    else:
        inner = task.varied_simulator(num_envs, variation, device)
    if isinstance(grounding, GroundingModel):
        return GroundedSimulator(inner, grounding, scatter=scatter)
    if isinstance(grounding, ResidualModel):
        return AugmentedSimulator(inner, grounding, scatter=scatter)
    return inner if scatter is None else RandomizedSimulator(inner, scatter)


@torch.no_grad()
def hidden_before(grounding: Grounding | None, windows: Windows, every: int = 1) -> Tensor | None:
    """Return the hidden states (E, ceil(T / every), H) of the histories before every so many-th step.

    Histories begin where `windows` do. None where the grounding remembers nothing.
    """
    if isinstance(grounding, ResidualModel):
        return _memory_before(grounding, windows, every)
    if not isinstance(grounding, GroundingModel):
        return None
    _, after = grounding.encode(windows)
    return functional.pad(after[:, :-1], (0, 0, 1, 0))[:, ::every]


def _memory_before(model: ResidualModel, windows: Windows, every: int) -> Tensor:
    memory = model.initial_memory(len(windows.state))
    before = []
    for first in range(0, windows.state.shape[1], every):
        before.append(memory)
        steps = slice(first, first + every)
        _, memory = model.correct(
            windows.state[:, steps], windows.action[:, steps], windows.simulated_next[:, steps], memory
        )
    return torch.stack(before, dim=1)


def start_simulator(
    simulator: Simulator,
    state: Tensor,
    rows: Tensor,
    goal: Tensor,
    *,
    hidden: Tensor | None = None,
    previous_action: Tensor | None = None,
) -> None:
    """Begin episodes in `rows` (n,) at `state` (n, X) with `goal` (n, G).

    `hidden` (n, H) and `previous_action` (n, A) are of the history before `state`, by default none.
    """
    if isinstance(simulator, GroundedSimulator):
        simulator.reset_to(state, rows, goal, hidden=hidden, previous_action=previous_action)
    elif isinstance(simulator, AugmentedSimulator):
        simulator.reset_to(state, rows, hidden)
    else:
        simulator.reset_to(state, rows)
    varied = varied_within(simulator)
    if varied is not None:
        varied.parameters = varied.variation.redraw(varied.parameters, rows)


def varied_within(simulator: Simulator) -> VariedSimulator | None:
    """Return the simulator with varying parameters inside `simulator`, if there is one."""
    inner = simulator.simulator if isinstance(simulator, RandomizedSimulator) else simulator
    return inner if isinstance(inner, VariedSimulator) else None


def remembering_within(simulator: Simulator) -> RememberingSimulator | None:
    """Return the simulator inside `simulator` that remembers more than states tell, if there is one."""
    inner: object = simulator
    while hasattr(inner, "simulator"):
        inner = inner.simulator
    return inner if isinstance(inner, RememberingSimulator) else None
