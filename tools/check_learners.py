"""Train each learner on a standard task and compare it with a published figure, or with another library.

    uv run python tools/check_learners.py
    uv run python tools/check_learners.py --only sac --only iql --seed 1

Published are single runs of RL Baselines3 Zoo. No dataset with published figures for implicit Q-learning
comes without a download: it learns from what SAC did while it learned, and so does d3rlpy's. None of the
settings here are in the paper.
"""

import subprocess
import tempfile
import time
from collections.abc import Callable
from enum import StrEnum
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from door import run_tool
from numpy.typing import NDArray
from pendulums import ENV, HORIZON, Pendulums, Recorder
from rich.console import Console
from rich.table import Table
from torch import Tensor

from astra_data.learning.iql import Experience, Iql, IqlConfig
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.policy import Policy, PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.learning.ppo import Ppo, PpoConfig
from astra_data.learning.sac import Sac, SacConfig

EPISODES = 100
UPDATES = 5_000
"""Of implicit Q-learning: of d3rlpy's, and of our critics."""
ZOO = "https://github.com/DLR-RM/rl-baselines3-zoo/blob/master/benchmark.md"
D3RLPY = Path(__file__).parent / "peers" / "d3rlpy_iql.py"

Returns = NDArray[np.float64]


class Learner(StrEnum):
    """What can be checked."""

    ppo = "ppo"
    recurrent_ppo = "recurrent_ppo"
    sac = "sac"
    iql = "iql"


def main(
    only: Annotated[list[Learner] | None, typer.Option(help="Check this alone; may be repeated.")] = None,
    seed: Annotated[int, typer.Option(help="Of everything.")] = 0,
) -> None:
    """Print mean and standard deviation of the returns of 100 episodes."""
    torch.set_num_threads(1)
    table = Table("learner", "task", "return", "to compare", "processor", "clock", title=f"seed {seed}")
    for learner in only or list(Learner):
        check, task, compared = CHECKS[learner]
        began, used = time.perf_counter(), time.process_time()
        returns = check(seed)
        seconds = [f"{time.process_time() - used:,.0f} s", f"{time.perf_counter() - began:,.0f} s"]
        table.add_row(learner, task, told(returns), compared(seed), *seconds)
    Console().print(table)
    typer.echo(f"Published: {ZOO}")


def told(returns: Returns) -> str:
    """Write mean and standard deviation over episodes."""
    return f"{returns.mean():.1f} ± {returns.std():.1f}"


@torch.no_grad()
def play(act: Callable[[Tensor, Tensor], Tensor], seed: int, *, hide_velocity: bool = False) -> Returns:
    """Return the returns of all episodes; `act` gets observations (B, O) and the actions before (B, A)."""
    env = Pendulums(EPISODES, seed=10_000 + seed, hide_velocity=hide_velocity)
    observation, action = env.reset(), torch.zeros(EPISODES, 1)
    returns = np.zeros(EPISODES)
    for _ in range(HORIZON):
        action = act(observation, action).clamp(-1.0, 1.0)
        step = env.step(action)
        observation = step.observation
        returns += step.reward.double().numpy()
    return returns


def play_policy(policy: Policy, seed: int, *, hide_velocity: bool = False) -> Returns:
    """Play the mean action."""
    hidden = policy.initial_hidden(EPISODES)

    def act(observation: Tensor, previous_action: Tensor) -> Tensor:
        nonlocal hidden
        features, hidden = policy.remember(observation, previous_action, hidden)
        return policy.act(features)

    return play(act, seed, hide_velocity=hide_velocity)


def ppo(seed: int, *, memory_size: int = 0) -> Returns:
    """Train for 100 k steps as the zoo does, in shorter stretches of more pendulums.

    Where there is a memory, it has to make up for the velocity.
    """
    config = PpoConfig(
        total_steps=100_352,
        rollout_steps=64,
        epochs=10,
        minibatches=16 if memory_size else 64,
        learning_rate=1e-3,
        discount=0.9,
        entropy_weight=0.0,
    )
    env = Pendulums(64, seed=seed, hide_velocity=memory_size > 0)
    torch.manual_seed(seed)
    policy = ActorCritic(ActorCriticShape(env.observation_size, env.action_size, memory_size))
    learner = Ppo(env, policy, config, horizon=HORIZON, seed=seed)
    while not learner.done:
        learner.iterate()
    return play_policy(policy, seed, hide_velocity=memory_size > 0)


@cache
def train_by_sac(seed: int) -> tuple[Policy, dict[str, Tensor]]:
    """Train for 20 k steps, in four pendulums at once; return the actor and the early episodes."""
    env = Recorder(4, seed=seed)
    config = SacConfig(total_steps=20_000, rollout_steps=200, updates_per_step=env.num_envs, discount=0.99)
    torch.manual_seed(seed)
    actor = SoftActor(PolicyShape(env.observation_size, env.action_size, hidden_sizes=(256, 256)))
    learner = Sac(env, actor, config, horizon=HORIZON, seed=seed)
    while not learner.done:
        learner.iterate()
    return actor, env.early_episodes()


def sac(seed: int) -> Returns:
    """Play the mean action of SAC's actor."""
    actor, _ = train_by_sac(seed)
    return play_policy(actor, seed)


IQL = IqlConfig(
    critic_updates=UPDATES,
    critic_batch=256,
    critic_sizes=(256, 256),
    critic_learning_rate=3e-4,
    expectile=0.7,
    discount=0.99,
    return_steps=1,
    reward_scale=0.1,
    policy_updates=4 * UPDATES,
    batch_windows=256,
    window=1,
    burn_in=0,
    learning_rate=1e-3,
    temperature=3.0,
)
"""The settings of the method's authors for locomotion, which are d3rlpy's, but for the policy's training:
ours begins with smaller weights and learns more slowly."""


def iql(seed: int) -> Returns:
    """Learn from early episodes of SAC."""
    _, episodes = train_by_sac(seed)
    action, reward = episodes["action"], episodes["reward"]
    experience = Experience(
        observation=episodes["observation"],
        previous_action=torch.zeros_like(action),
        action=action,
        reward=reward,
        next_observation=episodes["next_observation"],
        terminated=torch.zeros_like(reward, dtype=torch.bool),
        lengths=torch.full((len(reward),), HORIZON),
    )
    torch.manual_seed(seed)
    policy = ActorCritic(ActorCriticShape(3, 1, hidden_sizes=(256, 256)))
    learner = Iql(policy, experience, IQL, seed=seed)
    while not learner.done:
        learner.iterate()
    return play_policy(policy, seed)


def iql_by_d3rlpy(seed: int) -> str:
    """Let d3rlpy learn from the same episodes, by its own settings; tell its returns, and the data's."""
    _, episodes = train_by_sac(seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episodes.npz"
        timeout = torch.zeros_like(episodes["reward"])
        timeout[:, -1] = 1.0
        np.savez(
            file,
            observation=episodes["observation"].flatten(0, 1),
            action=episodes["action"].flatten(0, 1),
            reward=IQL.reward_scale * episodes["reward"].flatten(),
            timeout=timeout.flatten(),
        )
        command = ["uv", "run", "--quiet", "--no-project", "--python", "3.12", "--with", "d3rlpy"]
        command += ["--with", f"torch=={torch.__version__.partition('+')[0]}", "python", str(D3RLPY), "learn"]
        done = subprocess.run(
            [*command, str(file), str(UPDATES), str(seed)], stdout=subprocess.PIPE, text=True, check=True
        )
    returns = np.array(done.stdout.splitlines()[-1].split(), dtype=np.float64)
    recorded = episodes["reward"].double().sum(1).numpy()
    return f"{told(returns)} d3rlpy, {told(recorded)} in the data"


CHECKS: dict[Learner, tuple[Callable[[int], Returns], str, Callable[[int], str]]] = {
    Learner.ppo: (ppo, f"{ENV}, 100 k steps", lambda _: "-172.2 ± 104.2 published"),
    Learner.recurrent_ppo: (
        partial(ppo, memory_size=64),
        f"{ENV} without velocity, 100 k steps",
        lambda _: "-172.2 ± 104.2 published with velocity",
    ),
    Learner.sac: (sac, f"{ENV}, 20 k steps", lambda _: "-157.0 ± 88.7 published"),
    Learner.iql: (iql, f"{ENV}, early episodes of SAC", iql_by_d3rlpy),
}


if __name__ == "__main__":
    run_tool(main)
