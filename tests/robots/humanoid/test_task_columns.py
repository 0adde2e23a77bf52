"""Whether the entries of the humanoid's abstract states are what tasks say of them."""

from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.model import COMMANDED, FEET, JOINTS, STANDING, Locomotion, humanoid_model
from astra_data.robots.humanoid.target import HumanoidEnv
from astra_data.robots.humanoid.tasks import HUMANOID_TASKS, Walking
from astra_data.worlds.task import Task

WALKER, KINEMATICS, EXTENDED = HUMANOID_TASKS


def told(task: Task, state: Floats) -> dict[str, float]:
    """Return the entries of a target state's abstraction by their names."""
    names = task.abstract_state.names
    assert names is not None
    return dict(zip(names, task.abstraction(state[None])[0].tolist(), strict=True))


@pytest.mark.parametrize("task", HUMANOID_TASKS, ids=lambda task: task.name)
def test_quantities_are_of_entries_of_their_name_and_unit(task: Task) -> None:
    names, words = np.array(task.abstract_state.names), task.abstract_state.astra or {}
    beginnings = {
        "height_m": ("z",),
        "pitch_rad": ("pitch",),
        "velocity_m_s": ("vx", "vz"),
        "pitch_rate_rad_s": ("pitch_rate",),
        "mass_m": ("mass_x", "mass_y", "mass_z"),
        "mass_velocity_m_s": ("mass_vx", "mass_vy", "mass_vz"),
        "up": ("up_x", "up_y", "up_z"),
        "spin_rad_s": ("wx", "wy", "wz"),
    }
    legs = ("left_hip", "left_knee", "right_hip", "right_knee")
    joints = legs if task is WALKER else JOINTS
    beginnings |= {"joints_rad": joints, "joint_rates_rad_s": tuple(f"{name}_rate" for name in joints)}
    units = {"height_m": "m", "mass_m": "m", "up": "1"}
    for name, entries in task.quantities.items():
        assert tuple(names[list(entries)]) == beginnings[name]
        unit = "m/s" if name.endswith("m_s") else "rad/s" if name.endswith("rad_s") else "rad"
        assert {words["unit"][entry] for entry in entries} == {units.get(name, unit)}


@pytest.mark.parametrize("task", HUMANOID_TASKS, ids=lambda task: task.name)
def test_joints_have_the_angles_and_rates_that_their_names_say(task: Task) -> None:
    state = np.array(STANDING)
    state[7:24], state[30:] = 0.01 * np.arange(17), 0.1 * np.arange(17)
    seen = told(task, state)
    short = dict(zip(("left_hip", "left_knee", "right_hip", "right_knee"), COMMANDED, strict=True))
    numbers = short if task is WALKER else {name: number for number, name in enumerate(JOINTS)}
    for name, number in numbers.items():
        assert seen[name] == pytest.approx(0.01 * number)
        assert seen[f"{name}_rate"] == pytest.approx(0.1 * number)


def test_motion_and_lean_are_told_by_their_names() -> None:
    state = np.array(STANDING)
    state[24:27] = [0.1, 0.2, 0.3]
    walker, extended = told(WALKER, state), told(EXTENDED, state)
    assert [walker[name] for name in ("z", "pitch", "vx", "vz")] == pytest.approx([1.4, 0.0, 0.1, 0.3])
    assert [extended[f"mass_v{axis}"] for axis in "xyz"] == pytest.approx([0.1, 0.2, 0.3])
    state[3:7] = np.cos(0.2), 0.0, np.sin(0.2), 0.0  # leaning forward by 0.4 rad
    state[27:30] = [0.4, 0.5, 0.6]
    walker, extended = told(WALKER, state), told(EXTENDED, state)
    assert (walker["pitch"], walker["pitch_rate"]) == pytest.approx((0.4, 0.5))
    assert [extended[f"up_{axis}"] for axis in "xyz"] == pytest.approx([-np.sin(0.4), 0.0, np.cos(0.4)])
    assert [extended[f"w{axis}"] for axis in "xyz"] == pytest.approx([0.4, 0.5, 0.6])


def test_the_center_of_mass_is_told_by_its_names() -> None:
    model, state = humanoid_model(), np.array(STANDING)
    state[7 + JOINTS.index("left_shoulder1")] = -0.8
    state[7 + JOINTS.index("left_hip_y")] = -0.6
    data = mujoco.MjData(model)
    data.qpos[:] = state[:24]
    mujoco.mj_forward(model, data)
    expected = data.subtree_com[1] - np.mean([data.geom(foot).xpos for foot in FEET], axis=0) * [1, 1, 0]
    seen = told(EXTENDED, state)
    assert [seen[f"mass_{axis}"] for axis in "xyz"] == pytest.approx(expected.tolist())
    assert np.abs(expected).min() > 1e-3 and np.abs(np.diff(expected)).min() > 1e-3


@pytest.mark.parametrize(("lifted", "touches"), [("left", (0.0, 1.0)), ("right", (1.0, 0.0))])
def test_contacts_are_told_by_the_foots_name(lifted: str, touches: tuple[float, float]) -> None:
    state = np.array(STANDING)
    state[2] -= 0.11  # Gymnasium's humanoid starts 0.107 m above the floor
    state[7 + JOINTS.index(f"{lifted}_knee")] = -1.0
    seen = told(WALKER, state)
    assert (seen["left_contact"], seen["right_contact"]) == touches


def test_episodes_last_as_long_as_gymnasiums() -> None:
    steps = gymnasium.spec("Humanoid-v5").max_episode_steps
    assert [task.objective.horizon for task in HUMANOID_TASKS] == [steps] * 3


def test_targets_are_judged_by_the_tasks_own_locomotion() -> None:
    picky = Locomotion(healthy_m=(1.45, 2.0))
    for task in HUMANOID_TASKS:
        objective = task.objective
        assert isinstance(objective, Walking)
        changed = replace(task, objective=replace(objective, locomotion=picky))
        env = changed.target(1, seed=0, num_threads=1)
        assert isinstance(env, HumanoidEnv)
        env.reset()
        assert env.step(torch.zeros(1, 4)).terminated.all()
