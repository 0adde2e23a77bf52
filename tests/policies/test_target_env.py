import pytest
import torch
from torch import Tensor

from astra_data.policies.episodes import ObservedTargetEnv
from astra_data.policies.networks import ActorCritic, ActorCriticShape
from astra_data.policies.running_policy import Observed, RunningPolicy
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]


def recorded() -> tuple[Tensor, Tensor]:
    """Return moments of two episodes that walked, with goals of their own."""
    env = TASK.target(2, seed=4, num_threads=1)
    env.reset()
    states = []
    for _ in range(5):
        states.append(env.state)
        env.step(torch.tensor([[1.0, 0.0], [0.0, -1.0]]))
    return torch.cat(states), torch.tensor([[3.0, -4.0], [-4.0, 1.0]]).repeat(5, 1)


def world(observed: Observed = "full", share: float = 0.0, count: int = 4, threads: int = 1) -> ObservedTargetEnv:
    starts = recorded() if share else None
    return ObservedTargetEnv(TASK, count, observed=observed, starts=starts, data_start_share=share, num_threads=threads)


def stretch(env: ObservedTargetEnv, count: int, seed: int) -> list[Tensor]:
    """Act at random for `count` steps; rows 1 and 3 start anew in the midst of it."""
    torch.manual_seed(seed)
    seen = []
    for step in range(count):
        outcome = env.step(2 * torch.rand(4, 2) - 1)
        seen += [outcome.observation, outcome.reward, outcome.terminated]
        if step == count // 2:
            seen.append(env.reset(torch.tensor([False, True, False, True])))
    return seen


@pytest.mark.parametrize("threads", [1, 2])
def test_going_on_from_a_saved_state_is_exact(threads: int) -> None:
    torch.manual_seed(1)
    env = world(share=0.5)
    env.reset()
    stretch(env, 12, seed=2)
    saved = {name: values.clone() for name, values in env.state_dict().items()}
    expected = stretch(env, 12, seed=3)
    torch.manual_seed(9)
    other = world(share=0.5, threads=threads)
    other.reset()
    other.load_state_dict(saved)
    for values, again in zip(expected, stretch(other, 12, seed=3), strict=True):
        assert torch.equal(values, again)


def test_all_of_the_state_is_observed_in_full_and_the_planar_part_otherwise() -> None:
    state = recorded()[0][7]
    goal = torch.tensor([4.0, 0.0])
    shown: dict[Observed, list[int]] = {"abstract": [0, 1, 15, 16], "full": list(range(29))}
    for observed, entries in shown.items():
        env = world(observed, count=1)
        assert env.observation_size == (8 if observed == "abstract" else 33)

        def observe(state: Tensor, env: ObservedTargetEnv = env) -> Tensor:
            # The physics has the state in doubles; its clock, first, is not observed.
            physics = env.state_dict()["physics"]
            physics[:, 1:30] = state.double()
            return env.load_state_dict({"physics": physics, "goal": goal[None]})[0]

        before = observe(state)
        moved = [not torch.equal(observe(state + 0.1 * unit), before) for unit in torch.eye(29)]
        assert [entry for entry, is_moved in enumerate(moved) if is_moved] == entries and before.abs().max() < 3


def test_a_deployed_policy_sees_what_it_saw_in_training() -> None:
    torch.manual_seed(0)
    env = world("full")
    observation = env.reset()
    policy = ActorCritic(ActorCriticShape(33, 2))
    deployed = RunningPolicy(TASK, policy, observed="full")
    assert deployed.observation_size == 33
    deployed.start(4)
    expected, _ = policy.policy(observation)
    saved = env.state_dict()
    with torch.no_grad():
        assert torch.equal(deployed.act(saved["physics"][:, 1:30].float(), saved["goal"]), expected)
