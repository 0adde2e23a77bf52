"""A policy with its encoder and memory as one ONNX graph, without state."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from astra_data.core.errors import BadInputError, optional
from astra_data.policies.networks import UserPolicy
from astra_data.policies.running_policy import Memory, RunningPolicy

_DECOMPOSED: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.hypot.default: lambda x, y: (x.square() + y.square()).sqrt()
}  # operations that ONNX has not
ONNX = "policy.onnx"
INPUTS, OUTPUTS = ("state", "goal", "hidden"), ("command", "next_hidden")
TOLERANCE = 1e-3  # of commands of the graph, in half ranges: more than rounding does

_COMPARED_STEPS = 100
_MOST_DRAWS = 100  # of a state for which the policy has a command

Graph = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


class PolicyGraph(nn.Module):
    """One step of a policy on one robot: its hidden state, of `parts` (1, H), is an argument and a result."""

    def __init__(self, deployed: RunningPolicy) -> None:
        super().__init__()
        networks = (deployed.policy, deployed.source_encoder, deployed.target_encoder)
        self.networks = nn.ModuleList([network for network in networks if isinstance(network, nn.Module)])
        self._deployed = deployed
        deployed.start(1)
        self.parts = {name: part.shape[1] for name, part in deployed.memory._asdict().items()}

    @property
    def example(self) -> tuple[Tensor, Tensor, Tensor]:
        """A state (1, S), a goal (1, G) and the hidden state (1, H) at the start, all zeros."""
        task, hidden = self._deployed.task, sum(self.parts.values())
        return torch.zeros(1, task.state.size), torch.zeros(1, task.objective.goal_size), torch.zeros(1, hidden)

    def forward(self, state: Tensor, goal: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command (1, A), in its units, and the next hidden state (1, H)."""
        robot = replace(self._deployed)
        robot.resume(Memory(*hidden.split(list(self.parts.values()), dim=-1)))
        # Not `command`, whose checks depend on values and cannot be traced.
        return robot.task.limits.in_units(robot.act(state, goal)), torch.cat(robot.memory, dim=-1)


def write_graph(deployed: RunningPolicy, folder: Path) -> tuple[dict[str, int], float]:
    """Write the policy as ONNX; return the sizes of its hidden state's parts, and how many half ranges it differs."""
    optional("onnxscript")
    if isinstance(deployed.policy, UserPolicy):
        advice = "export it with its own library, or act with astra_data.load_policy"
        raise BadInputError(f"{deployed.policy.name} is a policy of another learner, which cannot be traced: {advice}")
    graph = PolicyGraph(deployed).eval()
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of torch's exporters, about torch's own code
        try:
            model = _onnx(graph, graph.example, input_names=INPUTS, output_names=OUTPUTS)
        except Exception as error:
            raise _not_traceable(deployed, error) from error
    (folder / ONNX).write_bytes(model.SerializeToString(deterministic=True))
    return graph.parts, _apart(graph, load_onnx(folder / ONNX))


def load_onnx(path: Path) -> Graph:
    """Return the graph of an ONNX file, run on one core."""
    runtime = optional("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def run(*values: Tensor) -> tuple[Tensor, Tensor]:
        feed = {name: value.numpy() for name, value in zip(INPUTS, values, strict=True)}
        command, hidden = session.run(None, feed)
        return torch.from_numpy(command), torch.from_numpy(hidden)

    return run


def _onnx(module: nn.Module, example: tuple[Tensor, ...], **names: Sequence[str]) -> Any:  # noqa: ANN401
    """Return a module as an ONNX model, without the lines and paths of the code that made it."""
    exported = torch.export.export(module, example, strict=False).run_decompositions(_DECOMPOSED)
    program = torch.onnx.export(exported, dynamo=True, verbose=False, **names)  # type: ignore[arg-type]
    assert program is not None
    model: Any = program.model_proto
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    return model


def _not_traceable(deployed: RunningPolicy, error: Exception) -> BadInputError:
    """Return the error that names the task's function which cannot be traced."""
    task, objective, (state, goal, _) = deployed.task, deployed.task.objective, PolicyGraph(deployed).example
    functions: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
        "abstraction": (task.abstraction, (state,)),
        "objective.observe": (objective.observe, (torch.zeros(1, task.abstract_state.size), goal)),
        "beyond": (task.beyond, (state,)),
        "objective.limit_command": (
            lambda action: objective.limit_command(action, deployed.command_limit),
            (torch.zeros(1, objective.action_size),),
        ),
    }
    name, cause = "the policy", error
    for candidate, (function, given) in functions.items():
        module = nn.Module()
        module.forward = function
        try:
            _onnx(module, given)
        except Exception as found:  # noqa: BLE001 - it is the user's code
            name, cause = candidate, found
            break
    while cause.__cause__ is not None:
        cause = cause.__cause__  # type: ignore[assignment]
    reason = f"{type(cause).__name__}: {next(iter(str(cause).strip().splitlines()), '')}"
    wanted = "expected operations of torch alone, and no branch that depends on values"
    return BadInputError(f"{task.name}: {name} cannot be written as a graph ({reason}): {wanted}")


def _apart(graph: PolicyGraph, written: Graph) -> float:
    """Return how far a written graph's commands are from the policy's, in random states that have a command."""
    rng, deployed, (state, goal, hidden), largest = np.random.default_rng(0), graph._deployed, graph.example, 0.0
    low, high = torch.tensor(list(deployed.task.limits.values())).unbind(-1)
    deployed.start(1)
    for step in range(_COMPARED_STEPS):
        before = deployed.memory
        for _ in range(_MOST_DRAWS):
            deployed.resume(before)
            state, goal = (torch.from_numpy(rng.standard_normal(x.shape, np.float32)) for x in (state, goal))
            expected = deployed.command(state, goal)
            if expected.isfinite().all():
                break
        else:
            fault = f"the policy gives no finite command for {_MOST_DRAWS} random states"
            wanted = "expected φ and the objective to be finite for values around 0"
            raise BadInputError(f"{deployed.task.name}: {fault}: {wanted}")
        command, hidden = written(state, goal, hidden)
        apart = float(((command - expected).abs() * 2 / (high - low)).max())
        if not apart <= TOLERANCE:
            fault = f"{ONNX} gives the command {command[0].tolist()}, the policy {expected[0].tolist()}"
            why = "does φ or the objective depend on more than its arguments?"
            raise BadInputError(f"{deployed.task.name}: in step {step} {fault}: {why}")
        largest = max(largest, apart)
    return largest
