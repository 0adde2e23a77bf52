"""Train the ant's low-level velocity controller with SAC, and measure a checkpoint.

    uv run python tools/train_low_level.py train --out runs/low_level --seed 0
    uv run python tools/train_low_level.py evaluate

Training takes about 30 minutes on one core.
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from ant_velocity import AntVelocityConfig, AntVelocityEnv
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors.numpy import save_file
from torch import nn

from astra_data.policies.networks import PolicyShape, SoftActor
from astra_data.policies.sac import Sac, SacConfig
from astra_data.robots.ant.body import VelocityController

SETTLED_STEPS = 20
"""One second after a command change, tracking counts as settled."""
LONGEST_STEPS = 1000
"""Control steps after which ants are reset."""

app = typer.Typer(add_completion=False, help=__doc__)


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint and the learning curve.")],
    seed: Annotated[int, typer.Option(help="Of networks, commands and batches.")] = 0,
    steps: Annotated[int, typer.Option(help="Environment steps at 0.7 of the full torque.")] = 1_200_000,
    full_torque_steps: Annotated[int, typer.Option(help="Environment steps after that.")] = 480_000,
) -> None:
    """Train one controller; write `controller.safetensors` and `curve.json`, refreshed every 32 k steps."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    curve: list[dict[str, float]] = []
    torch.manual_seed(seed)
    shape = PolicyShape(AntVelocityEnv.observation_size, AntVelocityEnv.action_size, hidden_sizes=(128, 128))
    actor = SoftActor(shape)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, TimeRemainingColumn()) as progress:
        for torque_scale, count in ((0.7, steps), (1.0, full_torque_steps)):
            env = AntVelocityEnv(AntVelocityConfig(torque_scale=torque_scale, num_threads=1), seed=seed)
            bar = progress.add_task(f"torque {torque_scale}", total=count, note="")
            config = SacConfig(total_steps=count, rollout_steps=500)
            sac = Sac(env, actor, config, horizon=LONGEST_STEPS, seed=seed)
            while not sac.done:
                sac.iterate()
                settled = env.steps_since_change > SETTLED_STEPS
                error = float(env.tracking_error()[settled].mean())
                curve.append({"torque_scale": torque_scale, "steps": sac.steps, "error_m_s": error})
                progress.update(bar, completed=sac.steps, note=f"{error:.3f} m/s")
                save(actor, torque_scale, out / "controller.safetensors")
                (out / "curve.json").write_text(json.dumps(curve, indent=1))


def save(actor: SoftActor, torque_scale: float, path: Path) -> None:
    """Write the layers of a SAC actor's mean as a controller checkpoint."""
    linears = [layer for layer in actor.actor if isinstance(layer, nn.Linear)]
    tensors = {"torque_scale": np.array(torque_scale, dtype=np.float32)}
    for index, layer in enumerate(linears):
        rows = layer.out_features // 2 if layer is linears[-1] else layer.out_features
        tensors[f"{index}.weight"] = layer.weight.detach()[:rows].numpy().copy()
        tensors[f"{index}.bias"] = layer.bias.detach()[:rows].numpy().copy()
    temporary = path.with_suffix(".tmp")
    save_file(tensors, temporary)
    temporary.replace(path)


@app.command()
def evaluate(
    checkpoint: Annotated[Path | None, typer.Argument(help="By default the one shipped.")] = None,
    steps: Annotated[int, typer.Option(help="Control steps per ant.", min=5 * SETTLED_STEPS)] = 1000,
    num_envs: Annotated[int, typer.Option(help="Ants.")] = 256,
) -> None:
    """Print tracking error, lag and falls of a checkpoint as JSON."""
    typer.echo(json.dumps(measure(VelocityController.load(checkpoint), steps, num_envs), indent=2))


def measure(controller: VelocityController, steps: int, num_envs: int) -> dict[str, object]:
    """Return tracking error in m/s by steps since a command change, gain, standing speed, falls."""
    env = AntVelocityEnv(AntVelocityConfig(num_envs=num_envs), seed=1)
    env.reset()
    by_age: dict[int, list[float]] = {age: [] for age in (1, 4, 8, 15, 20)}
    settled: list[float] = []
    standing: list[float] = []
    followed = commanded = 0.0
    falls = 0
    for _ in range(steps):
        env.physics.step(controller(env.physics.qpos, env.physics.qvel, env.command))
        age, error = env.steps_since_change + 1, env.tracking_error()
        for wanted, errors in by_age.items():
            errors.extend(error[age == wanted])
        late = age > SETTLED_STEPS
        settled.extend(error[late])
        velocity, command = env.physics.qvel[late, :2], env.command[late]
        standing.extend(np.linalg.norm(velocity[~command.any(axis=1)], axis=1))
        followed += float((velocity * command).sum())
        commanded += float((command**2).sum())
        fallen = env.fallen()
        falls += int(fallen.sum())
        env.draw_due_commands()
        if fallen.any():
            env.reset(torch.from_numpy(fallen))
    return {
        "error_after_1s_m_s": float(np.mean(settled)),
        "error_by_steps_since_change_m_s": {age: float(np.mean(errors)) for age, errors in by_age.items()},
        "gain": followed / commanded,
        "speed_standing_m_s": float(np.mean(standing)),
        "falls_per_1000_steps": 1000.0 * falls / (steps * num_envs),
    }


if __name__ == "__main__":
    app()
