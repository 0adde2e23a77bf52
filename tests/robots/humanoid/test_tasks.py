import json
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from quick_runs import run_here
from torch import Tensor
from torch.nn import functional

from astra_data.dataset.columns import GOAL
from astra_data.dataset.reader import Dataset
from astra_data.grounding.files import load_history_model
from astra_data.robots.humanoid import target as humanoid
from astra_data.robots.humanoid import tasks
from astra_data.robots.humanoid.tasks import (
    HumanoidExtendedKinematics,
    HumanoidKinematics,
    HumanoidWalker2d,
    walker_model,
)
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task
from astra_data.worlds.variation import JointVariation, VariedSimulator

NOTHING = torch.zeros(3, 0)


@pytest.mark.parametrize(
    ("kind", "bias", "scatter", "early"), [(tasks.PlanarWalking, 0.1, 0.8, 0.0), (tasks.MassWalking, 0.03, 0.05, 4.0)]
)
def test_pay_and_falls_are_the_targets_but_for_costs(
    kind: type[tasks.Walking], bias: float, scatter: float, early: float
) -> None:
    """Of what the humanoid does under random commands; `early`: steps by which falls are told too early.

    `scatter` is of the steps after which it looks along x, as it is paid there and as simulators take it to.
    """
    env = humanoid.HumanoidEnv(humanoid.Locomotion(effort_cost=0.0, contact_cost=0.0), 32, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    objective, alive = kind(horizon=5), torch.ones(32, dtype=torch.bool)
    wrong, astray, misjudged = [], [], []
    for number in range(80):
        if number % 7 == 0:
            action = 2 * torch.rand(32, 4, generator=generator) - 1
        states = [env.state.numpy()]
        step = env.step(action)
        states.append(env.state.numpy())
        before, after = (torch.from_numpy(objective.phi(state))[alive] for state in states)
        failed = objective.missed(after, NOTHING)
        judged_alike = failed == step.terminated[alive]
        paid = objective.reward(before, after, NOTHING, failed)
        wrong.append((paid - step.reward[alive])[judged_alike])
        w, x, y, z = torch.from_numpy(states[1])[alive][judged_alike, 3:7].unbind(-1)
        astray.append(torch.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)).abs())
        misjudged.append(~judged_alike)
        alive &= ~step.terminated
    assert int(alive.sum()) < 8 and abs(float(torch.cat(wrong).mean())) < bias
    straight = torch.cat(astray) < 0.03
    assert straight.float().mean() > 0.05 and float(torch.cat(wrong)[straight].square().mean().sqrt()) < scatter
    assert float(torch.cat(misjudged).sum()) / 32 <= early


def test_the_walkers_mass_moves_as_mujoco_says() -> None:
    objective, model = tasks.PlanarWalking(horizon=5), walker_model()
    heights = torch.tensor([[1.0], [1.01], [1.99], [2.0]])
    assert objective.missed(heights, NOTHING).tolist() == [True, False, False, True]
    masses = torch.tensor([[0.0] * 36 + [mass_m] + [0.0] * 9 for mass_m in (0.64, 0.65)])
    assert tasks.MassWalking(horizon=5).missed(masses, NOTHING).tolist() == [True, False]
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    data.qpos[1:], data.qvel[:] = [1.4, 0.3, -0.4, -1.0, 0.2, -0.5], generator.normal(size=7)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    after = torch.zeros(1, 15)
    after[0, :13] = torch.from_numpy(np.concatenate([data.qpos[1:], data.qvel]))
    assert float(objective.velocity(after, after)) == pytest.approx(data.subtree_linvel[0, 0], abs=1e-5)


def test_joints_are_paid_for_the_way_of_the_torso_over_the_lower_foot() -> None:
    objective, model = tasks.JointWalking(horizon=5), humanoid.humanoid_model()
    data = mujoco.MjData(model)
    poses = np.zeros((2, 17))  # the left knee is drawn up, so that the right foot is the lower one; then both hips turn
    poses[:, humanoid.COMMANDED[1]] = -1.0
    poses[1, [humanoid.COMMANDED[0], humanoid.COMMANDED[2]]] = 0.02, 0.1
    feet = []
    for pose in poses:
        data.qpos[:] = humanoid.STANDING[:24]
        data.qpos[7:] = pose
        mujoco.mj_forward(model, data)
        feet.append([data.geom(name).xpos.copy() for name in humanoid.FEET])
    (left, right), (_, later) = feet
    assert right[2] < left[2]
    velocity = (right[0] - later[0]) / humanoid.TIMESTEP_S
    before, after = torch.zeros(2, 1, 34)
    before[0, :17], after[0, :17] = torch.from_numpy(poses).float()
    reward = objective.reward(before, after, NOTHING[:1], torch.zeros(1, dtype=torch.bool))
    assert abs(velocity) > 1.0 and float(reward) == pytest.approx(5.0 + 1.25 * velocity, rel=1e-4)
    assert not objective.missed(after, NOTHING[:1]).any()


KINDS = (HumanoidWalker2d, HumanoidKinematics, HumanoidExtendedKinematics)
Kind = type[HumanoidWalker2d] | type[HumanoidKinematics]
ACTION = torch.tensor([[-0.5, -0.2, 0.4, 0.1]])


def moving(kind: Kind, count: int) -> Tensor:
    """Return states (count, X) of humanoids under random commands."""
    env = humanoid.HumanoidEnv(humanoid.Locomotion(), count, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        env.step(2 * torch.rand(count, 4, generator=generator) - 1)
    state: Tensor = kind.abstraction(env.state)
    return state


def varied(kind: Kind, state: Tensor, variation: JointVariation) -> tasks.VariedHumanoid:
    simulator = tasks.VariedHumanoid(kind(len(state)), variation)
    simulator.reset_to(state)
    return simulator


def plain(kind: Kind, state: Tensor) -> Any:
    simulator = kind(len(state))
    simulator.reset_to(state)
    return simulator


@pytest.mark.parametrize("kind", KINDS)
def test_plain_parameters_are_the_plain_simulator(kind: Kind) -> None:
    torch.manual_seed(0)
    state = moving(kind, 6)
    ours, theirs = varied(kind, state, JointVariation()), plain(kind, state)
    assert isinstance(ours, VariedSimulator)
    for _ in range(20):
        action = torch.randn(6, 4)
        assert torch.equal(ours.step(action), theirs.step(action))
    assert torch.equal(ours.state, ours.simulator.state)
    rows = torch.tensor([1, 4])
    for simulator in (ours, theirs):
        simulator.reset_to(state[:2], rows)
    assert torch.equal(ours.state, theirs.state) and not ours.blocked.any()
    landed = ours.state + 0.01
    assert torch.equal(ours.settle(ours.state, landed), theirs.settle(theirs.state, landed))


@pytest.mark.parametrize("kind", KINDS)
def test_commands_are_scaled_as_far_as_there_is_room(kind: Kind) -> None:
    state = moving(kind, 2)
    longer = varied(kind, state, JointVariation(action_scale=(0.5, 0.5)))
    command = torch.tensor([[-0.4, 0.2, 0.6, 0.9], [5.0, -5.0, 0.0, 0.0]])
    expected = torch.tensor([[-0.6, 0.3, 0.9, 1.0], [1.0, -1.0, 0.0, 0.0]])
    torch.testing.assert_close(longer.step(command), plain(kind, state).step(expected), atol=1e-5, rtol=1e-5)
    # Cut off first, a command out of reach is not what it was either.
    shorter = varied(kind, state, JointVariation(action_scale=(-0.5, -0.5)))
    expected = torch.tensor([[-0.2, 0.1, 0.3, 0.45], [0.5, -0.5, 0.0, 0.0]])
    torch.testing.assert_close(shorter.step(command), plain(kind, state).step(expected), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS[1:])
@pytest.mark.parametrize(("friction", "scale"), [(1.0, 1.0), (2.0, 1.5)])
def test_joints_approach_their_targets(kind: Kind, friction: float, scale: float) -> None:
    variation = JointVariation(friction=(friction, friction), timestep_scale=(scale, scale))
    simulator = varied(kind, kind(1).state, variation)
    action = torch.tensor([[-0.5, -0.2, 0.7, 9.0]])
    for _ in range(7):
        landed = simulator.step(action)[0]
    targets = humanoid.commanded_angles(action[0]).tolist()
    # Gains 200 and 10; hips are damped by 5, knees by 1.
    for joint, target, damping in zip(humanoid.COMMANDED, targets, [5.0, 1.0, 5.0, 1.0], strict=True):
        rate = 200 / (10 + friction * damping)
        left = math.exp(-rate * 7 * scale * 0.015)
        assert float(landed[joint]) == pytest.approx(target * (1 - left), abs=1e-5)
        assert float(landed[17 + joint]) == pytest.approx(target * rate * left, abs=1e-4)
    assert not landed[[joint for joint in range(17) if joint not in humanoid.COMMANDED]].any()


def test_walkers_have_the_damping_and_the_time_that_they_were_given() -> None:
    state = moving(HumanoidWalker2d, 3)
    state[:, 0] += 0.2  # off the floor
    simulator = varied(HumanoidWalker2d, state, JointVariation())
    friction, scale = [0.5, 1.0, 2.0], [1.0, 1.5, 0.8]
    simulator.parameters = simulator.parameters.clone()
    for name, values in (("friction", friction), ("timestep_scale", scale)):
        simulator.parameters[:, simulator.variation.names.index(name)] = torch.tensor(values)
    after = simulator.step(ACTION.expand(3, 4))
    for row in range(3):
        model = walker_model()
        model.dof_damping[3:] *= friction[row]
        model.opt.timestep *= simulator.parameters[row, simulator.variation.names.index("timestep_scale")]
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:] = state[row, :6].numpy(), state[row, 6:13].numpy()
        data.ctrl[:] = humanoid.commanded_angles(ACTION[0].double()).numpy()
        mujoco.mj_step(model, data, 5)
        assert data.time == pytest.approx(0.015 * scale[row])
        landed = torch.tensor([*data.qpos[1:], *data.qvel]).float()
        torch.testing.assert_close(after[row, :13], landed, atol=1e-5, rtol=1e-5)


HUMANOID_TASKS = (tasks.WALKER2D, tasks.KINEMATICS, tasks.EXTENDED)


@pytest.mark.parametrize("task", HUMANOID_TASKS, ids=lambda task: task.name)
def test_phi_and_what_is_beyond_it_lose_only_the_place(task: Task) -> None:
    generator = torch.Generator().manual_seed(0)
    state = torch.tensor(humanoid.STANDING) + 0.03 * torch.randn(47, generator=generator)
    state[3:7] = functional.normalize(torch.tensor([0.9, 0.2, 0.3, 0.1]), dim=0)
    changed = state + 1e-2 * torch.eye(47)
    changed[:, 3:7] = functional.normalize(changed[:, 3:7], dim=-1)

    def known(states: torch.Tensor) -> torch.Tensor:
        return torch.cat([task.abstraction(states), task.beyond(states)], dim=-1)

    kept = (known(changed) - known(state)).abs().amax(-1) > 1e-3
    assert kept.tolist() == [False] * 2 + [True] * 45


RECIPE = """
task = "humanoid-walker2d"
methods = ["direct_transfer", "astra"]
seeds = [0]

[collect]
episodes = 8
max_steps = 40
start = "task"
hold_s = [0.03, 0.2]

[ground]
updates = 3
batch_windows = 4
window = 20
latent_size = 8
held_out_share = 0.25
"""


@pytest.mark.usefixtures("quick_fits")
def test_a_simulator_without_goals_is_grounded(tmp_path: Path) -> None:
    (tmp_path / "toy.toml").write_text(RECIPE)
    folder = run_here(tmp_path / "toy.toml", until="ground")
    assert GOAL not in Dataset.open(folder / "pair" / "seed_0").features
    ground = folder / "ground" / "astra" / "seed_0"
    model = load_history_model(ground / "grounding.safetensors")
    assert (model.shape.goal_size, model.shape.position_octaves) == (0, 0)
    gap = json.loads((ground / "gap.json").read_text())
    assert gap["raw"].keys() == TASKS["humanoid-walker2d"].quantities.keys()
