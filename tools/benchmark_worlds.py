"""Measure how fast the worlds step, against what the physics engine and a plain Gymnasium loop allow.

    uv run python tools/benchmark_worlds.py
    uv run python tools/benchmark_worlds.py --json runs/worlds.json

All figures come from one process, the target's in turns over the same stretches of time, so that their
ratios hold even on a machine that does other work too.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import gymnasium
import gymnasium_robotics
import mujoco
import torch
import typer
from rich.console import Console
from rich.table import Table
from timing import Candidates, Stretch, measure

from astra_data.core.arrays import Floats
from astra_data.core.provenance import cores
from astra_data.robots.ant.tasks import CONTROL_SUBSTEPS, AntMazeEnv, VelocityController, ant_model
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.navigation import PlanarObjective

TASK = TASKS["antmaze-umaze"]
GYMNASIUM_ID = "AntMaze_UMaze-v5"

gymnasium.register_envs(gymnasium_robotics)


def main(
    num_envs: Annotated[int, typer.Option(help="Ants.")] = 128,
    num_points: Annotated[int, typer.Option(help="Point masses.")] = 4096,
    rounds: Annotated[int, typer.Option(help="Turns that each candidate takes.")] = 6,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print control steps per second of the target and of the abstract simulator, and the ratios."""
    torch.set_num_threads(1)
    threads = cores()
    figures = measure_target(num_envs, threads, rounds)
    figures |= steps_per_second({"point_mass": point_mass_stretch(num_points, steps=100)}, rounds)
    ratios = {
        "target / physics limit": figures["target"] / figures["physics_limit"],
        "target / Gymnasium loop": figures["target"] / figures["gymnasium_loop"],
    }
    table = Table("steps/s", "", title=f"{num_envs} ants, {num_points} points, {threads} threads")
    for name, figure in figures.items():
        table.add_row(name.replace("_", " "), f"{figure:,.0f}")
    table.add_section()
    for name, ratio in ratios.items():
        table.add_row(name, f"{ratio:.2f}")
    Console().print(table)
    if json_path is not None:
        report = {"num_envs": num_envs, "num_points": num_points, "threads": threads, **figures, **ratios}
        json_path.write_text(json.dumps(report, indent=2) + "\n")


class RecordingController(VelocityController):
    """The shipped controller, keeping the torques (B, 8) that it gave."""

    def __init__(self, controller: VelocityController) -> None:
        self.controller = controller
        self.torques: list[Floats] = []

    def __call__(self, qpos: Floats, qvel: Floats, command: Floats) -> Floats:
        """Return and keep torques (B, 8)."""
        self.torques.append(self.controller(qpos, qvel, command))
        return self.torques[-1]


def measure_target(num_envs: int, threads: int, rounds: int) -> dict[str, float]:
    """Return control steps per second of our target, of bare physics, and of Gymnasium's own maze."""
    controller = RecordingController(VelocityController.load())
    assert isinstance(TASK.objective, PlanarObjective)
    env = AntMazeEnv(TASK.objective, num_envs, seed=0, controller=controller, num_threads=threads)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    starts = [env.physics.qpos, env.physics.qvel]

    def target() -> int:
        env.reset(env.failed)
        starts[:] = env.physics.qpos.copy(), env.physics.qvel.copy()
        controller.torques.clear()
        for _ in range(25):
            env.step(2 * torch.rand(num_envs, 2, generator=generator) - 1)
        return 25 * num_envs

    model = ant_model(TASK.maze)
    data = [mujoco.MjData(model) for _ in range(num_envs)]
    pool = ThreadPoolExecutor(threads)

    def replay(row: int) -> None:
        one = data[row]
        mujoco.mj_resetData(model, one)
        one.qpos[:], one.qvel[:] = starts[0][row], starts[1][row]
        for torques in controller.torques:
            one.ctrl[:] = torques[row]
            mujoco.mj_step(model, one, CONTROL_SUBSTEPS)

    def physics_limit() -> int:
        # The ants' last stretch once more, ant by ant on all cores: nothing but physics, and no waiting.
        list(pool.map(replay, range(num_envs)))
        return len(controller.torques) * num_envs

    single = gymnasium.make(GYMNASIUM_ID)
    single.reset(seed=0)

    def gymnasium_loop() -> int:
        for _ in range(100):
            _, _, terminated, truncated, _ = single.step(single.action_space.sample())
            if terminated or truncated:
                single.reset()
        return 100

    return steps_per_second(
        {"target": target, "physics_limit": physics_limit, "gymnasium_loop": gymnasium_loop}, rounds
    )


def steps_per_second(candidates: Candidates, rounds: int) -> dict[str, float]:
    """Return the steps per second of each of the candidates, which take turns."""
    return {name: rate.clock for name, rate in measure(candidates, rounds).items()}


def point_mass_stretch(num_points: int, steps: int) -> Stretch:
    """Step point masses in the maze with random commands."""
    simulator = TASK.simulator(num_points)
    centers = torch.tensor(TASK.maze.free_centers(), dtype=torch.float32)
    position = centers[torch.arange(num_points) % len(centers)]
    simulator.reset_to(torch.cat([position, torch.zeros_like(position)], dim=-1))
    command = 2 * torch.rand(num_points, 2) - 1

    def stretch() -> int:
        for _ in range(steps):
            simulator.step(command)
        return steps * num_points

    return stretch


if __name__ == "__main__":
    typer.run(main)
