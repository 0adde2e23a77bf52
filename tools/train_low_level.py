"""Train the ant's low-level velocity controller with SAC and write its checkpoint and card.

    uv run python tools/train_low_level.py train --out runs/low_level/seed_0 --seed 0
    uv run python tools/train_low_level.py evaluate runs/low_level/seed_0/controller.safetensors

The first part runs in MuJoCo's Euler integrator (3.7 times faster), the second in RK4, the integrator of
the target environment. About 25 minutes on one core.
"""

import json
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors.numpy import save_file
from torch import nn

from astra_data.ant import VelocityController
from astra_data.envs.ant_velocity import AntVelocityConfig, AntVelocityEnv
from astra_data.learners.sac import SacConfig, train_sac

app = typer.Typer(add_completion=False, help=__doc__)


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint and the learning curve.")],
    seed: Annotated[int, typer.Option()] = 0,
    euler_steps: Annotated[int, typer.Option(help="Environment steps in Euler.")] = 1_000_000,
    rk4_steps: Annotated[int, typer.Option(help="Environment steps in RK4.")] = 650_000,
    torque_scale: Annotated[float, typer.Option()] = 1.0,
) -> None:
    """Train one controller and write `controller.safetensors` and `curve.json`."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    curve: list[dict[str, float]] = []
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
    network: nn.Sequential | None = None
    with Progress(*columns) as progress:
        for integrator, env_steps in (("Euler", euler_steps), ("RK4", rk4_steps)):
            env = AntVelocityEnv(AntVelocityConfig(integrator=integrator, num_threads=1), seed=seed)
            bar = progress.add_task(integrator, total=env_steps, note="")
            errors: list[float] = []
            began = time.perf_counter()

            def report(steps: int, network: nn.Sequential) -> None:
                settled = env.steps_since_change > 20
                if settled.any():
                    errors.append(float(env.tracking_error()[settled].mean()))
                if steps % (env.num_envs * 500) == 0:
                    error = float(np.mean(errors))
                    errors.clear()
                    seconds = time.perf_counter() - began
                    curve.append({"steps": steps, "seconds": seconds, "error_m_s": error})
                    progress.update(bar, completed=steps, note=f"{error:.3f} m/s, {steps / seconds:.0f} steps/s")
                    save(network, out / "controller.safetensors")
                    (out / "curve.json").write_text(json.dumps(curve))
                    print(integrator, steps, round(error, 3), round(steps / seconds), flush=True)

            random_steps = 10_000 if network is None else 0
            config = SacConfig(env_steps=env_steps, random_steps=random_steps)
            network = train_sac(env, config, seed=seed, network=network, on_step=report)
            save(network, out / f"controller_{integrator}.safetensors")
    save(network, out / "controller.safetensors")


def save(network: nn.Sequential, path: Path) -> None:
    """Write the mean part of a SAC actor as a controller checkpoint."""
    linears = [layer for layer in network if isinstance(layer, nn.Linear)]
    tensors: dict[str, np.ndarray] = {}
    for index, layer in enumerate(linears):
        rows = layer.out_features // 2 if layer is linears[-1] else layer.out_features
        tensors[f"{index}.weight"] = layer.weight.detach()[:rows].numpy().copy()
        tensors[f"{index}.bias"] = layer.bias.detach()[:rows].numpy().copy()
    temporary = path.with_suffix(".tmp")
    save_file(tensors, temporary)
    temporary.replace(path)


@app.command()
def evaluate(
    checkpoint: Annotated[Path, typer.Argument(help="A controller checkpoint.")],
    steps: Annotated[int, typer.Option(help="Control steps per ant.")] = 1000,
    num_envs: Annotated[int, typer.Option()] = 256,
) -> None:
    """Print tracking error, lag and falls of a checkpoint as JSON."""
    controller = VelocityController.load(checkpoint)
    env = AntVelocityEnv(AntVelocityConfig(num_envs=num_envs), seed=1)
    env.reset()
    errors: dict[int, list[float]] = {}
    settled: list[float] = []
    along: list[tuple[float, float]] = []
    falls = 0
    for _ in range(steps):
        command = env.command.copy()
        env.physics.step(controller(env.physics.qpos, env.physics.qvel, command))
        error = env.tracking_error()
        age = env.steps_since_change
        for step in (1, 4, 8, 15, 20):
            errors.setdefault(step, []).extend(error[age == step - 1])
        settled.extend(error[age >= 20])
        velocity = env.physics.qvel[:, :2]
        rows = age >= 20
        along.append((float((velocity[rows] * command[rows]).sum()), float((command[rows] ** 2).sum())))
        fallen = env.fallen()
        falls += int(fallen.sum())
        env.steps_since_change += 1
        env._draw_commands(np.flatnonzero(env.steps_since_change >= env._hold))
        if fallen.any():
            env.reset(torch.from_numpy(fallen))
    gains = np.array(along).sum(axis=0)
    figures = {
        "error_after_1s_m_s": float(np.mean(settled)),
        "error_by_steps_since_change_m_s": {step: float(np.mean(values)) for step, values in errors.items()},
        "gain": float(gains[0] / gains[1]),
        "falls_per_1000_steps": 1000.0 * falls / (steps * num_envs),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    app()
