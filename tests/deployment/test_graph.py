import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import GIVEN, Rail, Reach
from small_cart import TASK as CART
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.deployment.graph import ONNX, PolicyGraph, _apart, load_onnx, write_graph
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.policies.networks import ActorCritic, AdaptiveShape, PolicyShape, SoftActor, Student
from astra_data.policies.running_policy import RunningPolicy
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task

ANT = TASKS["antmaze-umaze"]


class Stay(Reach):
    """The cart's objective without goals."""

    goal_size = 0


class Speed(Rail):
    """An abstraction with an operation that ONNX has not."""

    @staticmethod
    def abstraction(state: Tensor) -> Tensor:
        return torch.hypot(state[..., :1], state[..., 1:])


def lively[P: ActorCritic](policy: P) -> P:
    """Make its actions of some size."""
    with torch.no_grad():
        for weight in policy.actor[-1].parameters():
            weight.mul_(50)
    return policy


def actor(observation_size: int, action_size: int = 2, **sizes: Any) -> ActorCritic:
    return lively(ActorCritic(PolicyShape(observation_size, action_size, hidden_sizes=(8,), **sizes)))


def policies() -> dict[str, RunningPolicy]:
    torch.manual_seed(0)
    latent = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    aligned = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8)
    rma = AdaptiveShape(8, 2, hidden_sizes=(8,), extrinsics_size=3)
    still = Task(**GIVEN | {"make_simulator": Speed, "objective": Stay(horizon=40)})
    whole = SoftActor(PolicyShape(33, 2, hidden_sizes=(8,)))
    return {
        "target encoder": RunningPolicy(ANT, actor(16, memory_size=8), latent, aligned, command_limit=0.4),
        "adaptive": RunningPolicy(ANT, lively(Student(rma))),
        "full state": RunningPolicy(ANT, whole, observed="full"),
        "units, no goal": RunningPolicy(still, actor(1, 1, memory_size=4)),
    }


POLICIES = policies()


@pytest.mark.parametrize("name", POLICIES)
def test_the_graph_acts_as_the_policy_step_after_step(name: str, tmp_path: Path) -> None:
    deployed = POLICIES[name]
    write_graph(deployed, tmp_path)
    content = (tmp_path / ONNX).read_bytes()
    assert not re.search(rb"\.py\b|astra_data", content), "no paths of the machine"
    if name == "units, no goal":
        write_graph(deployed, tmp_path)
        assert (tmp_path / ONNX).read_bytes() == content
    task, rng = deployed.task, np.random.default_rng(1)
    written, hidden = load_onnx(tmp_path / ONNX), PolicyGraph(deployed).example[2]
    deployed.start(1)
    spread, apart = [], 0.0
    for _ in range(200):
        state, goal = (
            torch.from_numpy(rng.standard_normal((1, size), np.float32))
            for size in (task.state.size, task.objective.goal_size)
        )
        expected = task.limits.in_units(deployed.act(state, goal))
        spread.append(expected)
        command, hidden = written(state, goal, hidden)
        apart = max(apart, float((command - expected).abs().max()))
    assert apart <= 1e-5
    assert torch.cat(spread).std(dim=0).max() > 0.05, "the policy does something"


def test_what_is_no_number_is_not_the_policys_command() -> None:
    graph = PolicyGraph(POLICIES["units, no goal"])
    with pytest.raises(BadInputError, match=r"in step 0 policy.onnx gives the command \[nan\], the policy"):
        _apart(graph, lambda state, goal, hidden: (torch.full((1, 1), torch.nan), hidden))


@torch.no_grad()
def test_states_without_an_abstraction_are_not_compared() -> None:
    """A graph is only told wrong by states of which there is an angle."""
    task = replace(CART, abstraction=lambda state: torch.asin(state[..., :1]))
    graph, again = (PolicyGraph(RunningPolicy(task, actor(2, 1, memory_size=4))) for _ in range(2))
    again.load_state_dict(graph.state_dict())
    assert _apart(graph, again) < 1e-4
    nowhere = replace(CART, abstraction=lambda state: torch.asin(2 + state[..., :1].square()))
    graph = PolicyGraph(RunningPolicy(nowhere, actor(2, 1)))
    with pytest.raises(BadInputError, match=r"rail-cart: the policy gives no finite command for 100 random"):
        _apart(graph, graph)


def through_numpy(state: Tensor) -> Tensor:
    return torch.from_numpy(np.asarray(state.numpy())[..., :1])


def branching(state: Tensor) -> Tensor:
    return state[..., :1] if float(state[0, 0]) > 0 else state[..., 1:]


class Forgetful:
    calls = 0

    def __call__(self, state: Tensor) -> Tensor:
        self.calls += 1
        return state[..., :1] + self.calls


@pytest.mark.parametrize(
    ("abstraction", "told"),
    [
        (through_numpy, "abstraction cannot be written as a graph .*: expected operations of torch"),
        (branching, "abstraction cannot be written as a graph .*, and no branch"),
        (Forgetful(), r"in step 0 policy.onnx gives the command \[.*\], the policy \[.*\]: does φ"),
    ],
)
def test_code_that_is_no_graph_is_named_in_one_line(abstraction: Any, told: str, tmp_path: Path) -> None:
    task = replace(CART, abstraction=abstraction)
    torch.manual_seed(0)  # of the policy, by which commands differ from the first step on
    with pytest.raises(BadInputError, match=f"rail-cart: {told}") as raised:
        write_graph(RunningPolicy(task, actor(2, 1)), tmp_path)
    assert "\n" not in str(raised.value)


def test_differences_are_the_largest_in_half_ranges() -> None:
    graph, more = PolicyGraph(POLICIES["units, no goal"]), iter([0.0024])  # of a command from -1 to 4

    def off(*given: Tensor) -> tuple[Tensor, Tensor]:
        command, hidden = graph(*given)
        return command + next(more, 0.0), hidden

    with torch.no_grad():
        assert _apart(graph, off) == pytest.approx(0.0024 / 2.5, rel=1e-2)
