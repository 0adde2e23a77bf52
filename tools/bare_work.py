"""The least that a training does: its simulator's steps, and its networks' passes, forward and backward.

Losses, optimizers, clipping, sampling and data are left out. What makes the same updates of the same networks
with torch cannot be faster, whoever wrote it.
"""

import torch
from timing import Stretch
from torch import Tensor

from astra_data.grounding.encoder import mlp
from astra_data.policies.networks import ActorCritic
from astra_data.policies.ppo import EPOCHS, MINIBATCHES, PpoConfig
from astra_data.policies.simulator_env import SimulatorEnv


def bare_ppo(env: SimulatorEnv, policy: ActorCritic, config: PpoConfig) -> Stretch:
    """Step the simulator, and pass a rollout through actor, critic and memory as often as PPO does."""
    envs, steps, updates = env.num_envs, config.rollout_steps, EPOCHS * MINIBATCHES
    rows = envs // MINIBATCHES
    observation, action = torch.randn(envs, env.observation_size), torch.zeros(envs, env.action_size)
    window = torch.randn(rows, steps, env.observation_size), torch.zeros(rows, steps, env.action_size)
    nothing, first = policy.initial_hidden(rows), torch.zeros(rows, steps)
    env.reset(torch.ones(envs, dtype=torch.bool))

    def stretch() -> int:
        with torch.no_grad():
            hidden = policy.initial_hidden(envs)
            for _ in range(steps):
                features, hidden = policy.remember(observation, action, hidden)
                policy.actor(features)
                policy.critic(features)
                env.step(action)
        for _ in range(updates):
            features = policy.remember_sequence(*window, nothing, first).flatten(0, 1)
            backward(policy.actor(features), policy.critic(features))
        return envs * steps

    return stretch


def bare_sac(env: SimulatorEnv, batch: int, updates: int, steps: int) -> Stretch:
    """Step the simulator, and pass batches through actor and twin critics as often as SAC does."""
    observed, acted, hidden = env.observation_size, env.action_size, (256, 256)
    actor = mlp((observed, *hidden, 2 * acted), torch.nn.ReLU)
    critics = [mlp((observed + acted, *hidden, 1), torch.nn.ReLU) for _ in range(2)]
    seen, pair = torch.randn(batch, observed), torch.randn(batch, observed + acted)
    row, action = torch.randn(env.num_envs, observed), torch.zeros(env.num_envs, acted)
    env.reset(torch.ones(env.num_envs, dtype=torch.bool))

    def update() -> None:
        with torch.no_grad():
            actor(seen)
            for slow in critics:
                slow(pair)
        backward(*(critic(pair) for critic in critics))
        chosen = torch.cat([seen, actor(seen)[:, :acted]], dim=-1)
        for critic in critics:
            critic.requires_grad_(False)
        backward(*(critic(chosen) for critic in critics))
        for critic in critics:
            critic.requires_grad_(True)

    def stretch() -> int:
        for _ in range(steps):
            with torch.no_grad():
                actor(row)
            env.step(action)
            for _ in range(updates):
                update()
        return steps * updates

    return stretch


def bare_iql(observed: int, acted: int, batch: int, updates: int) -> Stretch:
    """Pass batches through the value, the twin critics, their slow copies and the policy as IQL does."""
    hidden = (256, 256)
    value, policy = (mlp((observed, *hidden, size), torch.nn.ReLU) for size in (1, acted))
    critics = [mlp((observed + acted, *hidden, 1), torch.nn.ReLU) for _ in range(2)]
    seen, pair = torch.randn(batch, observed), torch.randn(batch, observed + acted)

    def stretch() -> int:
        for _ in range(updates):
            with torch.no_grad():
                value(seen)
                for slow in critics:
                    slow(pair)
            backward(value(seen), *(critic(pair) for critic in critics))
            backward(policy(seen))
        return updates

    return stretch


def backward(*outputs: Tensor) -> None:
    """Let the gradient of the outputs' sum flow back."""
    torch.stack([output.sum() for output in outputs]).sum().backward()
