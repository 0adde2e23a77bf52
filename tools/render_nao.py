"""Render the simulated NAO walking up to its ball and kicking it: a strip of frames, or an animation.

    uv run python tools/render_nao.py recipes/results/nao_walk.png
    uv run python tools/render_nao.py kick.gif --robot-seed 3

Needs OpenGL without a window: MUJOCO_GL=egl, which is the default here, or osmesa.
"""

import os
from pathlib import Path
from typing import Annotated

os.environ.setdefault("MUJOCO_GL", "egl")  # mujoco chooses when it is imported

import mujoco
import numpy as np
import typer
from PIL import Image

from astra_data.worlds.nao import BatchedNao
from astra_data.worlds.nao.robot import CONTROL_STEP_S

STRIP = 6
"""Frames of a strip."""
SECONDS = 5.4
SPEED_M_S = 0.2
BALL_M = 0.7
"""Ahead of the robot at the start."""
KICK_M = 0.18
"""Distance of the ball ahead of the robot when it kicks."""
UPPER_BODY = (
    ((0.0, -0.02, 0.17), (0.0, 0.02, 0.17), 0.055),
    ((0.0, 0.098, 0.1), (0.02, 0.12, 0.0), 0.025),
    ((0.02, 0.12, 0.0), (0.1, 0.1, -0.05), 0.022),
    ((0.0, -0.098, 0.1), (0.02, -0.12, 0.0), 0.025),
    ((0.02, -0.12, 0.0), (0.1, -0.1, -0.05), 0.022),
)
"""Head and arms, for the picture only: from and to in the torso's frame, radius, in m."""


def main(
    out: Annotated[Path, typer.Argument(help="A .png for a strip, a .gif for an animation.")],
    robot_seed: Annotated[int, typer.Option(help="Of the robot's traits.")] = 0,
    width: Annotated[int, typer.Option(help="Of a frame, in pixels.")] = 320,
) -> None:
    """Render and write `out`."""
    frames = render(robot_seed, width)
    if out.suffix == ".gif":
        milliseconds = round(1000 * CONTROL_STEP_S)
        frames[0].save(out, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
    else:
        chosen = [frames[index] for index in np.linspace(0, len(frames) - 1, STRIP).round().astype(int)]
        strip = Image.new("RGB", (width * STRIP, chosen[0].height))
        for place, frame in enumerate(chosen):
            strip.paste(frame, (place * width, 0))
        strip.save(out)
    typer.echo(f"{out}: {SECONDS:g} s of a robot with seed {robot_seed}")


def render(seed: int, width: int) -> list[Image.Image]:
    """Return one frame per control step."""
    robots = BatchedNao(1, seed=seed, ball=True)
    robots.reset(np.array([0]), np.zeros((1, 3)), np.random.default_rng(seed), np.array([[BALL_M, 0.03]]))
    model = robots.bodies.model
    data = mujoco.MjData(model)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
    model.geom_rgba[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = (0.30, 0.52, 0.33, 1.0)
    model.geom_rgba[model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE] = (0.96, 0.82, 0.25, 1.0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0.65, 0.0, 0.22)
    camera.distance, camera.azimuth, camera.elevation = 1.8, 75.0, -12.0
    frames = []
    with mujoco.Renderer(model, 3 * width // 4, width) as renderer:
        for _ in range(round(SECONDS / CONTROL_STEP_S)):
            x, y, yaw = robots.pose[0]
            kicks = robots.ball[0, 0] - x < KICK_M
            robots.step(np.array([[0.0 if kicks else SPEED_M_S, -y, -2.0 * yaw]]), kick=np.array([kicks]))
            data.qpos[:] = robots.bodies.qpos[0]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            _draw_limbs(renderer.scene, model, data)
            frames.append(Image.fromarray(renderer.render()))
    return frames


def _draw_limbs(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Draw rods from joint to joint, arms and a head; the model itself has only colliding shapes."""
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    torso, turned = data.xpos[1], data.xmat[1].reshape(3, 3)
    rods = [(data.xpos[model.body_parentid[body]], data.xpos[body], 0.028) for body in range(2, model.nbody)]
    rods = [rod for rod, parent in zip(rods, model.body_parentid[2:], strict=True) if parent]
    rods += [(torso + turned @ from_m, torso + turned @ to_m, width) for from_m, to_m, width in UPPER_BODY]
    for start, end, radius in rods:
        rod = scene.geoms[scene.ngeom]
        color = np.array([0.88, 0.88, 0.9, 1.0], dtype=np.float32)
        mujoco.mjv_initGeom(rod, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
        mujoco.mjv_connector(rod, capsule, radius, start, end)
        scene.ngeom += 1


if __name__ == "__main__":
    typer.run(main)
