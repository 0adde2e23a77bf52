"""Suboptimal policies, to collect data with: trained in the target, and stopped early."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from astra_data.core.config import Config
from astra_data.core.errors import BadInputError
from astra_data.core.logbook import Logbook
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.policies.behaviors import PolicyBehavior
from astra_data.policies.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.policies.networks.policy import Policy, PolicyShape
from astra_data.policies.networks.soft_actor import SoftActor
from astra_data.policies.policy_file import PolicyFile
from astra_data.policies.ppo import Ppo, PpoConfig
from astra_data.policies.running_policy import Observed, RunningPolicy
from astra_data.policies.sac import Sac, SacConfig
from astra_data.policies.target_env import ObservedTargetEnv
from astra_data.worlds.task import Task

_PPO_ENVS = 128
_SAC_ENVS = 32
"""Target environments stepped side by side."""

_SAC = SacConfig(buffer_size=1_000_000)
"""Settings with which the humanoid learns to stay up; its rewards are 5 a step."""
_SAC_SIZES = (256, 256)
"""Hidden layers of actor and critics."""

type Metadata = dict[str, Any]
"""What a dataset records about the behavior."""

_TEST_EPISODES = 32
"""Test episodes after each iteration."""


def suboptimal_by_ppo(
    task: Task, *, steps: int, seed: int, folder: Path, num_threads: int | None, progress: Progress
) -> tuple[PolicyFile, Metadata]:
    """Train a policy without memory by PPO in the target, on φ of its state; stop after `steps`.

    A checkpoint in `folder` lets the same call resume after an interruption.

    Returns:
        the policy, and how it was trained.
    """
    torch.manual_seed(derive(seed, "suboptimal policy"))
    world = ObservedTargetEnv(task, _PPO_ENVS, num_threads=num_threads)
    policy = ActorCritic(ActorCriticShape(world.observation_size, world.action_size))
    config = PpoConfig(total_steps=steps)
    ppo = Ppo(world, policy, config, horizon=task.objective.horizon, seed=seed)

    def judge(figures: Mapping[str, float]) -> tuple[float, str]:
        return ppo.steps / steps, f"reward per step {figures['reward']:.3f}"

    spent = _train(ppo, world, judge, folder, progress)
    return _finished(policy, "abstract"), _metadata(ppo, policy, config, spent)


def suboptimal_by_sac(
    task: Task,
    *,
    steps: int,
    episode_steps: int,
    seed: int,
    folder: Path,
    num_threads: int | None,
    progress: Progress,
) -> tuple[PolicyFile, Metadata]:
    """Train a policy without memory by SAC in the target, on its full state.

    Stop as soon as episodes last `episode_steps` on average, after `steps` at the latest. A checkpoint in
    `folder` lets the same call resume after an interruption.

    Returns:
        the policy, and how it was trained.

    Raises:
        BadInputError: the task's episodes end in success, so that lasting long is not good.
    """
    if not task.objective.is_lasting:
        raise BadInputError(f"in {task.name} good episodes are short: use 'suboptimal_ppo'")
    torch.manual_seed(derive(seed, "suboptimal policy"))
    world = ObservedTargetEnv(task, _SAC_ENVS, observed="full", num_threads=num_threads)
    actor = SoftActor(PolicyShape(world.observation_size, world.action_size, hidden_sizes=_SAC_SIZES))
    config = _SAC.model_copy(update={"total_steps": steps})
    sac = Sac(world, actor, config, horizon=task.objective.horizon, seed=seed)
    running = RunningPolicy(task, actor, observed="full")

    def judge(figures: Mapping[str, float]) -> tuple[float, str]:
        lasted = _lasts(running, derive(seed, f"trial {sac.steps}"), num_threads)
        return max(sac.steps / steps, lasted / episode_steps), f"episodes last {lasted:.0f} steps"

    spent = _train(sac, world, judge, folder, progress)
    return _finished(actor, "full"), _metadata(sac, actor, config, spent)


def _train(
    learner: Ppo | Sac,
    world: ObservedTargetEnv,
    judge: Callable[[Mapping[str, float]], tuple[float, str]],
    folder: Path,
    progress: Progress,
) -> dict[str, float]:
    """Train until `judge`, given the figures of an iteration, returns a share done of 1, with a note.

    Returns:
        the time spent, including that before an interruption.
    """

    def go_on(state: dict[str, Any]) -> None:
        observation = world.load_state_dict(state["world"])
        learner.load_state_dict(state["learner"], observation, goes_on=bool(state["world"]))

    logbook = Logbook(folder / "training.safetensors", go_on)
    share = logbook.points[-1]["share"] if logbook.points else 0.0
    while share < 1.0:
        share, note = judge(learner.iterate())
        logbook.points.append({"steps": learner.steps, "share": share})
        rate = learner.steps / logbook.stopwatch.seconds
        progress(min(1.0, share), f"training the behavior: {rate:,.0f} steps/s  {note}")
        if logbook.is_due or share >= 1.0:
            logbook.keep({"learner": learner.state_dict(), "world": world.state_dict()})
    return logbook.stopwatch.spent()


def _lasts(running: RunningPolicy, seed: int, num_threads: int | None) -> float:
    """Return how many steps episodes last on average with actions drawn from the policy.

    Training episodes would underestimate it: they began when the policy was worse.
    """
    behavior, task = PolicyBehavior(running), running.task
    env = task.target(_TEST_EPISODES, seed=derive(seed, "starts"), num_threads=num_threads)
    env.reset()
    behavior.start(range(_TEST_EPISODES), seed)
    active, lasted = torch.ones(_TEST_EPISODES, dtype=torch.bool), 0
    for _ in range(task.objective.horizon):
        if not active.any():
            break
        lasted += int(active.sum())
        active &= ~env.step(behavior.act(env.state, env.goal), active).terminated
    return lasted / _TEST_EPISODES


def _finished(policy: Policy, observed: Observed) -> PolicyFile:
    return PolicyFile(policy.requires_grad_(False), None, None, None, observed)


def _metadata(learner: Ppo | Sac, policy: Policy, config: Config, spent: Mapping[str, float]) -> Metadata:
    sizes = list(policy.shape.hidden_sizes)
    settings = {"num_envs": learner.env.num_envs, "hidden_sizes": sizes, **config.model_dump(mode="json")}
    return {"trained_steps": learner.steps, "learner": settings, "spent": spent}
