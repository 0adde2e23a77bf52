"""Train with Stable-Baselines3 in the abstract worlds of recipes/antmaze_long.toml, to be timed.

    uv run --with stable-baselines3 --with sb3-contrib python tools/peers/stable_baselines.py ppo vector

Makes one iteration per line of its input, and answers each with the number of environment steps.
"""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Any

import gymnasium
import torch
import typer
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from astra_data.core.config import load_recipe
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.simulator import NO_GROUNDING, Grounding
from astra_data.pipeline.recipe import Recipe
from astra_data.policies import ppo
from astra_data.policies.gymnasium import Array, BatchedVectorEnv, SeededSimulatorEnv, SingleEnv
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.train import PpoTrainConfig
from astra_data.robots.registry import TASKS
from astra_data.worlds.user_code import user_object

RECIPE = Path(__file__).parents[2] / "recipes" / "antmaze_long.toml"
SINGLE_WORLDS = 16
StableBaselinesEnv = user_object(f"{RECIPE.parent}/examples/methods/sb3_ppo.py:StableBaselinesEnv")


class Algorithm(StrEnum):
    """PPO in the grounded simulator, or RecurrentPPO in the raw one."""

    ppo = "ppo"
    recurrent_ppo = "recurrent_ppo"


class Face(StrEnum):
    """All rows of one batched world, or a few worlds of one row each (all of them would take minutes)."""

    vector = "vector"
    single = "single"


def main(algorithm: Algorithm, face: Face) -> None:
    """Train on demand."""
    torch.set_num_threads(1)
    settings = load_recipe(RECIPE, Recipe)
    task, config = TASKS[settings.task], settings.train
    assert isinstance(config, PpoTrainConfig)
    shape = GroundingShape(state_size=4, action_size=2, goal_size=2)
    grounding: Grounding = NO_GROUNDING
    if algorithm is Algorithm.ppo:
        grounding = HistoryGrounding(GroundingModel(shape).requires_grad_(False))
    horizon = task.objective.horizon

    def world(num_envs: int) -> SeededSimulatorEnv:
        return SeededSimulatorEnv(SimulatorEnv(task.objective, grounding.simulator(task, num_envs)))

    def single() -> gymnasium.Env[Array, Array]:
        return gymnasium.wrappers.TimeLimit(SingleEnv(world(1)), horizon)

    count = config.num_envs if face is Face.vector else SINGLE_WORLDS
    env = (
        StableBaselinesEnv(BatchedVectorEnv(world(count), horizon))
        if face is Face.vector
        else DummyVecEnv([single] * count)
    )
    sizes: dict[str, Any] = {"net_arch": list(config.hidden_sizes), "activation_fn": torch.nn.ELU}
    if algorithm is Algorithm.recurrent_ppo:
        # One memory for actor and critic, as ours has.
        sizes |= {"lstm_hidden_size": config.memory_size, "shared_lstm": True, "enable_critic_lstm": False}
    build = PPO if algorithm is Algorithm.ppo else RecurrentPPO
    steps = config.rollout_steps * count
    learner = build(
        "MlpPolicy" if algorithm is Algorithm.ppo else "MlpLstmPolicy",
        env,
        learning_rate=config.learning_rate,
        n_steps=config.rollout_steps,
        batch_size=steps // ppo.MINIBATCHES,
        n_epochs=ppo.EPOCHS,
        gamma=config.discount,
        gae_lambda=ppo.GAE_LAMBDA,
        clip_range=ppo.CLIP,
        vf_coef=ppo.VALUE_WEIGHT,
        max_grad_norm=ppo.GRADIENT_NORM,
        policy_kwargs=sizes,
        device="cpu",
    )
    for _ in sys.stdin:
        learner.learn(steps, reset_num_timesteps=False)
        print(steps, flush=True)


if __name__ == "__main__":
    typer.run(main)
