"""Measure how many steps a second a deployed policy makes for one robot, on one core.

    uv run python tools/benchmark_deployed.py
    uv run python tools/benchmark_deployed.py --seconds 10

The networks have the sizes of the AntMaze recipes; what they have learned is the same to the speed. The three
take turns, each with one thread; the processor's time counts, so that other work on the machine does not.
"""

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from astra_data.core.config import load_recipe
from astra_data.core.manifest import write_manifest
from astra_data.deployment.folder import describe
from astra_data.deployment.graph import write_graph
from astra_data.deployment.run_policy import RobotPolicy
from astra_data.experiments.recipe import Recipe
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.alignment import TargetEncoder
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.training.running_policy import RunningPolicy
from astra_data.training.train import PpoTrainConfig
from astra_data.worlds.registry import TASKS

SETTINGS = load_recipe(Path(__file__).parents[1] / "recipes" / "antmaze_long.toml", Recipe)
TASK = TASKS[SETTINGS.task]
ROUND_S = 0.2
LOOP = "run_policy.py"


def main(seconds: Annotated[float, typer.Option(help="Of each way to run each policy.")] = 3.0) -> None:
    """Print steps per second, and the slowest of a hundred steps of the ONNX loop."""
    torch.set_num_threads(1)
    print(f"{'steps/s':<28}{'ONNX loop':>12}{'astra-data':>13}{'ONNX, 99 %':>14}")
    for name, deployed in policies().items():
        with tempfile.TemporaryDirectory() as folder:
            steps = ways(deployed, Path(folder))
            spent: dict[str, list[float]] = {way: [] for way in steps}
            for _ in range(max(1, round(seconds / ROUND_S))):
                for way, step in steps.items():
                    spent[way] += timed(step)
            onnx, ours = (1.0 / float(np.mean(times)) for times in spent.values())
            slow_ms = 1e3 * float(np.percentile(spent[LOOP], 99))
        print(f"{name:<28}{onnx:>12,.0f}{ours:>13,.0f}{slow_ms:>11.3f} ms")


def policies() -> dict[str, RunningPolicy]:
    """Return a policy of the raw simulator and one of ASTRA, untrained."""
    config = SETTINGS.train
    assert isinstance(config, PpoTrainConfig)
    goal, action = TASK.objective.goal_size, TASK.objective.action_size
    model = GroundingModel(
        GroundingShape(TASK.abstract_state.size, action, goal, latent_size=SETTINGS.ground.latent_size)
    )
    encoder = TargetEncoder(
        TASK.state.size, goal, action, embedding_size=64, latent_size=SETTINGS.ground.latent_size
    )
    seen = RunningPolicy(TASK, ActorCritic(ActorCriticShape(1, action))).observation_size
    recurrent = ActorCriticShape(
        seen, action, memory_size=config.memory_size, hidden_sizes=config.hidden_sizes
    )
    latent = ActorCriticShape(seen + SETTINGS.ground.latent_size, action, hidden_sizes=config.hidden_sizes)
    return {
        "direct transfer, recurrent": RunningPolicy(TASK, ActorCritic(recurrent)),
        "ASTRA, target encoder": RunningPolicy(TASK, ActorCritic(latent), model, encoder),
    }


def ways(deployed: RunningPolicy, folder: Path) -> dict[str, Callable[[], object]]:
    """Return one step by the folder's own loop and by this package, from NumPy to NumPy."""
    written = write_graph(deployed, folder)
    about = describe(deployed, written.parts)
    (folder / "policy.json").write_text(json.dumps(about))
    write_manifest(folder, {})
    names = {column: about[column]["names"] for column in ("state", "goal")}
    policy = RobotPolicy(rate_hz=about["rate_hz"], folder=folder, **names)
    state, goal = (np.random.default_rng(0).standard_normal(len(names[column])) for column in names)
    deployed.start(1)

    def tensors() -> tuple[torch.Tensor, torch.Tensor]:
        return torch.from_numpy(state[None].astype("float32")), torch.from_numpy(goal[None].astype("float32"))

    return {
        LOOP: lambda: policy.act(state, goal),
        "astra-data": lambda: deployed.task.limits.in_units(deployed.act(*tensors()))[0].numpy(),
    }


def timed(step: Callable[[], object]) -> list[float]:
    """Return the processor's time in s of each step, as many as fit into a round."""
    times, ends = [], time.perf_counter() + ROUND_S
    with torch.no_grad():
        while time.perf_counter() < ends:
            began = time.process_time_ns()
            step()
            times.append((time.process_time_ns() - began) * 1e-9)
    return times


if __name__ == "__main__":
    typer.run(main)
