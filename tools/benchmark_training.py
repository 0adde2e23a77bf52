"""Measure how fast policies are trained, against other ways to do the same work.

    uv run python tools/benchmark_training.py
    uv run python tools/benchmark_training.py --only ppo --only target --quick
    uv run python tools/benchmark_training.py --json runs/training.json

Stable-Baselines3 and d3rlpy run in processes with environments of their own, which `uv` makes. The
candidates take turns over the same stretch of time, each with one torch thread. Rates are told by the clock
and by the processors' time, of all processes of a candidate together: the latter's ratios hold also on a
machine that does other work.
"""

import json
import math
from contextlib import ExitStack
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import gymnasium_robotics
import numpy as np
import torch
import typer
from timing import OURS, Candidates, Rate, Stretch, complain, measure, peer, print_rates

from astra_data.core.config import load_recipe
from astra_data.core.errors import AstraDataError
from astra_data.core.provenance import cores
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.simulator import NO_GROUNDING, Grounding
from astra_data.methods.iql import Experience, Iql, IqlConfig
from astra_data.pipeline.recipe import Recipe
from astra_data.policies import ppo as proximal
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.train import PpoTrainConfig
from astra_data.robots.ant.tasks import VelocityController
from astra_data.robots.registry import TASKS

SETTINGS = load_recipe(Path(__file__).parents[1] / "recipes" / "antmaze_long.toml", Recipe)
TASK = TASKS[SETTINGS.task]
SHAPE = GroundingShape(state_size=4, action_size=2, goal_size=2)
PEERS = Path(__file__).parent / "peers"
GYMNASIUM_ID = "AntMaze_UMaze-v5"
ANTS = 128
TORCH = torch.__version__.partition("+")[0]

gymnasium.register_envs(gymnasium_robotics)


class Part(StrEnum):
    """What can be measured."""

    ppo = "ppo"
    recurrent = "recurrent"
    iql = "iql"
    target = "target"


def main(
    only: Annotated[list[Part] | None, typer.Option(help="Measure this alone; may be repeated.")] = None,
    rounds: Annotated[int, typer.Option(help="Turns that each candidate takes.")] = 4,
    quick: Annotated[bool, typer.Option("--quick", help="One turn, and shorter ones.")] = False,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print rates, and ours over each of the others'."""
    torch.set_num_threads(1)
    figures: dict[str, dict[str, Rate]] = {}
    for part in only or list(Part):
        with ExitStack() as stack:
            try:
                title, candidates = MEASUREMENTS[part](quick, stack)
            except AstraDataError as error:
                raise typer.Exit(complain(str(error))) from None
            figures[title] = measure(candidates, 1 if quick else rounds)
    print_rates(figures)
    if json_path is not None:
        rates_of = {title: {name: asdict(rate) for name, rate in rates.items()} for title, rates in figures.items()}
        report = {"rounds": rounds, "quick": quick, "cores": cores(), "per_second": rates_of}
        json_path.write_text(json.dumps(report, indent=2) + "\n")


def grounded_ppo(_quick: bool, stack: ExitStack) -> tuple[str, Candidates]:
    """Train on latents in the grounded simulator; what the model has learned is the same to the speed."""
    grounding = HistoryGrounding(GroundingModel(SHAPE).requires_grad_(False))
    return (
        "PPO in the grounded simulator, steps",
        {
            OURS: ppo_stretch(grounding, memory_size=0),
            "Stable-Baselines3, one vector environment": stable_baselines(stack, "ppo", "vector"),
            "Stable-Baselines3, DummyVecEnv of 16": stable_baselines(stack, "ppo", "single"),
        },
    )


def recurrent_ppo(_quick: bool, stack: ExitStack) -> tuple[str, Candidates]:
    """Train a policy with a memory of its own in the raw simulator."""
    return (
        "PPO with a memory in the raw simulator, steps",
        {
            OURS: ppo_stretch(NO_GROUNDING, memory_size=SETTINGS.train.memory_size),
            "sb3-contrib, LSTM, one vector environment": stable_baselines(stack, "recurrent_ppo", "vector"),
            "sb3-contrib, LSTM, DummyVecEnv of 16": stable_baselines(stack, "recurrent_ppo", "single"),
        },
    )


def ppo_stretch(grounding: Grounding, memory_size: int) -> Stretch:
    """Make one iteration of the recipe's training."""
    env, policy, config = ppo_parts(grounding, memory_size)
    proximal._MAX_KL = math.inf  # all passes are made, as others make them
    ppo = proximal.Ppo(env, policy, config, horizon=TASK.objective.horizon, seed=0)

    def stretch() -> int:
        ppo.iterate()
        return config.num_envs * config.rollout_steps

    return stretch


def ppo_parts(grounding: Grounding, memory_size: int) -> tuple[SimulatorEnv, ActorCritic, PpoTrainConfig]:
    """Return what the recipe's training is made of."""
    config = SETTINGS.train
    assert isinstance(config, PpoTrainConfig)
    env = SimulatorEnv(TASK.objective, grounding.simulator(TASK, config.num_envs))
    shape = PolicyShape(
        observation_size=env.observation_size,
        action_size=env.action_size,
        memory_size=memory_size,
        hidden_sizes=config.hidden_sizes,
    )
    return env, ActorCritic(shape), config


def stable_baselines(stack: ExitStack, *arguments: str) -> Stretch:
    """Let Stable-Baselines3 make one iteration of the same size, in batches of the same number."""
    command = ["--with", "stable-baselines3", "--with", "sb3-contrib", "python"]
    return peer(stack, *command, str(PEERS / "stable_baselines.py"), *arguments)


def iql(quick: bool, stack: ExitStack) -> tuple[str, Candidates]:
    """Update critics and policy from single transitions, as the others do; random ones, for speed alone."""
    observation_size, action_size, updates = 8, 2, 20 if quick else 100
    episodes, steps = 100, 500
    torch.manual_seed(0)
    experience = Experience(
        observation=torch.randn(episodes, steps, observation_size),
        previous_action=torch.zeros(episodes, steps, action_size),
        action=2 * torch.rand(episodes, steps, action_size) - 1,
        reward=torch.randn(episodes, steps),
        next_observation=torch.randn(episodes, steps, observation_size),
        terminated=torch.zeros(episodes, steps, dtype=torch.bool),
        lengths=torch.full((episodes,), steps),
    )
    values, policy = (
        Iql(
            ActorCritic(PolicyShape(observation_size, action_size, hidden_sizes=(256, 256))),
            experience,
            IqlConfig(
                critic_updates=critic_updates,
                return_steps=1,
                policy_updates=1_000_000,
                batch_windows=256,
                window=1,
                burn_in=0,
            ),
            seed=0,
        )
        for critic_updates in (1_000_000, 1)
    )
    policy.iterate()  # The one update of the critics.

    def ours() -> int:
        for learner in (values, policy):  # one after the other, as a training does
            for _ in range(updates):
                learner.iterate()
        return updates

    command = ["--no-project", "--python", "3.12", "--with", "d3rlpy", "--with", f"torch=={TORCH}", "python"]
    command += [str(PEERS / "d3rlpy_iql.py"), str(observation_size), str(action_size)]
    return ("implicit Q-learning, updates of critics and policy", {OURS: ours, "d3rlpy": peer(stack, *command)})


def target(quick: bool, stack: ExitStack) -> tuple[str, Candidates]:
    """Step the ants by random commands through their low-level controller."""
    env = TASKS["antmaze-umaze"].target(ANTS, seed=0)
    env.reset()
    rng = np.random.default_rng(0)

    def ours(steps: int = 25) -> int:
        env.reset(env.failed)
        for _ in range(steps):
            env.step(torch.from_numpy(rng.uniform(-1, 1, (ANTS, 2))))
        return steps * ANTS

    count = cores()
    theirs = gymnasium.vector.AsyncVectorEnv([DrivenAnt] * count)
    stack.callback(theirs.close)
    theirs.reset(seed=0)

    def processes(steps: int = 200 if quick else 1000) -> int:
        for _ in range(steps):
            theirs.step(rng.uniform(-1, 1, (count, 2)))
        return steps * count

    return (f"AntMaze, steps of {ANTS} ants", {OURS: ours, f"Gymnasium's AsyncVectorEnv, {count} processes": processes})


class DrivenAnt(gymnasium.ActionWrapper[Any, Any, Any]):
    """Gymnasium's own AntMaze, given velocity commands (2,) through our low-level controller."""

    def __init__(self) -> None:
        """Make one."""
        super().__init__(gymnasium.make(GYMNASIUM_ID))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)
        self._controller = VelocityController()
        self._data: Any = self.unwrapped.ant_env.data  # type: ignore[attr-defined]

    def action(self, action: Any) -> Any:  # noqa: ANN401
        """Return the torques (8,)."""
        qpos, qvel = self._data.qpos[None, :15], self._data.qvel[None]
        return self._controller(qpos, qvel, action[None])[0]


MEASUREMENTS = {Part.ppo: grounded_ppo, Part.recurrent: recurrent_ppo, Part.iql: iql, Part.target: target}


if __name__ == "__main__":
    typer.run(main)
