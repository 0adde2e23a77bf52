from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.pipeline.stages.pair import pair_steps
from astra_data.robots.humanoid import walker2d
from astra_data.robots.humanoid.abstraction import humanoid_to_walker2d
from astra_data.robots.humanoid.model import CommandRanges, Locomotion
from astra_data.robots.humanoid.target import HumanoidEnv
from astra_data.robots.humanoid.walker2d import HumanoidWalker2d, walker_model
from astra_data.robots.registry import built, pairing_named

HELD = torch.tensor([3 / 7, 1.0, 3 / 7, 1.0])
"""Hips at zero, knees as straight as commands make them."""


def recorded(count: int, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return states, actions and next states of the humanoid under random commands."""
    env = HumanoidEnv(Locomotion(), count, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    rows = []
    for _ in range(steps):
        before, action = env.state, 2 * torch.rand(count, 4, generator=generator) - 1
        env.step(action)
        rows.append((before, action, env.state))
    state, action, next_state = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return state, action, next_state


def test_it_starts_upright() -> None:
    state = HumanoidWalker2d(2, num_threads=1).state
    assert state.dtype == torch.float32
    assert torch.equal(state[:, 0], torch.tensor([1.4, 1.4]))
    assert not state[:, 1:].any()


def test_it_shows_what_it_is_reset_to() -> None:
    state, action, _ = recorded(4, 20)
    abstract = humanoid_to_walker2d(state)
    assert 0 < float(abstract[:, 13:].mean()) < 1
    walker = HumanoidWalker2d(80, num_threads=1)
    walker.reset_to(abstract)
    assert torch.equal(walker.state, abstract)
    walker.step(action)
    kept = walker.state
    walker.reset_to(abstract[:2], torch.tensor([3, 5]))
    assert torch.equal(walker.state[[3, 5]], abstract[:2])
    others = [row for row in range(80) if row not in (3, 5)]
    assert torch.equal(walker.state[others], kept[others])
    assert not torch.equal(kept[3], abstract[0])  # what was handed out earlier stays


def test_it_can_be_paired() -> None:
    pairing = pairing_named(f"{Path(walker2d.__file__)}:HumanoidWalker2d")
    state, action, next_state = (values.numpy() for values in recorded(4, 20))
    batch = built(pairing, 32)
    columns, error = pair_steps(pairing, batch, state, action, next_state, tolerance=0.0)
    assert error == 0.0
    before, after, landed = (
        columns[f"abstract.{name}"] for name in ("state", "next_state", "simulated_next_state")
    )
    assert landed.dtype == np.float32
    # It foresees height, joints and all velocities, but not the pitch and its rate: of the humanoid, legs
    # move the pelvis first.
    foreseen = [0, 2, 3, 4, 5, 6, 7, *range(9, 13)]
    wrong, still = (np.sqrt(np.square(guess - after)[:, foreseen].mean(0)) for guess in (landed, before))
    assert (wrong < 0.6 * still).all()
    assert (wrong > 1e-5).all()


@pytest.mark.parametrize("num_threads", [1, 2])
def test_equals_mujoco_stepped_one_by_one(num_threads: int) -> None:
    """In the air, or on a floor that is as low as its feet."""
    state, action, _ = recorded(4, 20)
    abstract = humanoid_to_walker2d(state)
    walker = HumanoidWalker2d(80, num_threads=num_threads)
    walker.reset_to(abstract)
    landed = walker.step(action)
    targets = CommandRanges().targets(action.double()).numpy()
    model = walker_model()
    some_sunk = False
    for row in range(80):
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:] = abstract[row, :6].numpy(), abstract[row, 6:13].numpy()
        mujoco.mj_forward(model, data)
        is_foot = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
        sunk = max(0.0, -(data.geom_xpos[is_foot, 2] - model.geom_size[is_foot, 0]).min())
        some_sunk |= sunk > 0.01
        data.qpos[1] += sunk
        data.ctrl[:] = targets[row]
        mujoco.mj_step(model, data, 5)
        expected = np.concatenate([data.qpos[1:] - [sunk, *[0.0] * 5], data.qvel])
        np.testing.assert_allclose(landed[row, :13].numpy(), expected, rtol=1e-6, atol=1e-6)
    assert some_sunk


def test_walking_on_it_equals_mujoco_that_is_not_interrupted() -> None:
    """From poses of the humanoid, whose feet are often lower than the walker's floor was; for 0.9 s."""
    state, _, _ = recorded(6, 20)
    abstract = humanoid_to_walker2d(state[-24:])
    walker = HumanoidWalker2d(24, num_threads=2)
    walker.reset_to(abstract)
    assert (walker.memory > 0.01).any() and (walker.memory == 0.0).any()
    generator = torch.Generator().manual_seed(0)
    actions = (2 * torch.rand(6, 24, 4, generator=generator) - 1).repeat_interleave(10, 0)
    states = torch.stack([walker.step(action) for action in actions])
    model, apart = walker_model(), []
    for row in range(24):
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:] = abstract[row, :6].numpy(), abstract[row, 6:13].numpy()
        sunk = float(walker.memory[row])
        data.qpos[1] += sunk
        for step, action in enumerate(actions[:, row]):
            data.ctrl[:] = CommandRanges().targets(action.double()).numpy()
            mujoco.mj_step(model, data, 5)
            apart.append(abs(float(states[step, row, 0]) - (data.qpos[1] - sunk)))
    # Rollouts do not hand the solver's last answer on, and states are rounded.
    assert np.quantile(apart, 0.9) < 1e-5
    assert np.max(apart) < 1e-3


def test_a_floor_stays_where_it_is_until_the_walker_is_set_anew() -> None:
    walker = HumanoidWalker2d(3, num_threads=1)
    low = walker.state - torch.eye(15)[0] * torch.tensor([[0.0], [0.16], [0.2]])
    walker.reset_to(low)
    sunk = walker.memory.clone()
    assert sunk[0] == 0.0
    assert float(sunk[2] - sunk[1]) == pytest.approx(0.04, abs=1e-6)
    walker.step(HELD.expand(3, 4))
    assert torch.equal(walker.memory, sunk)
    walker.reset_to(low[[2]], torch.tensor([1]))
    assert torch.equal(walker.memory, sunk[[0, 2, 2]])
    walker.settle(walker.state, low[[0, 0, 0]])
    assert not walker.memory.any()


def test_contacts_are_those_of_the_feet() -> None:
    walker = HumanoidWalker2d(3, num_threads=1)
    state = walker.state
    # Gymnasium's humanoid starts 0.107 m above the floor.
    state[:, 0] -= torch.tensor([0.0, 0.107, 0.107])
    state[2, 2:4] = torch.tensor([-0.5, -1.0])  # the left leg lifted
    walker.reset_to(state)
    assert walker.step(HELD.expand(3, 4))[:, 13:].tolist() == [[0, 0], [1, 1], [0, 1]]


def test_commands_bend_the_joints_they_name() -> None:
    walker = HumanoidWalker2d(5, num_threads=1)
    action = HELD.repeat(5, 1)
    for joint in range(4):
        action[joint, joint] = -5.0  # as -1
    for _ in range(6):
        state = walker.step(action)
    moved = state[:4, 2:6] - state[4, 2:6]
    assert moved.abs().argmax(dim=1).tolist() == [0, 1, 2, 3]
    assert (moved.diagonal() < -0.2).all()
    assert (state[:4, 2:6].diagonal() > -1.25).all()


def fall_steps(world: HumanoidEnv | HumanoidWalker2d) -> tuple[Tensor, Tensor]:
    """Return after how many steps the torso leaves its healthy heights under `HELD`, and its last pitch."""
    count = len(world.state)
    steps, pitch = torch.zeros(count), torch.zeros(count)
    for _ in range(160):
        state = humanoid_to_walker2d(world.state) if isinstance(world, HumanoidEnv) else world.state
        healthy = state[:, 0] > 1.0
        steps += healthy
        pitch = torch.where(healthy, state[:, 1], pitch)
        world.step(HELD.expand(count, 4))
    return steps, pitch


def test_standing_still_it_falls_forward_as_soon_as_the_humanoid() -> None:
    env = HumanoidEnv(Locomotion(), 12, seed=0, num_threads=2)
    env.reset()
    walker = HumanoidWalker2d(12, num_threads=2)
    walker.reset_to(humanoid_to_walker2d(env.state))
    theirs, _ = fall_steps(env)
    ours, pitch = fall_steps(walker)
    assert float(ours.max()) < 160
    assert (pitch > 0.2).all()
    assert float(ours.mean()) == pytest.approx(float(theirs.mean()), rel=0.15)


def test_parameters_name_the_commands() -> None:
    walker = HumanoidWalker2d(1, ranges=CommandRanges(hip_deg=(-25.0, 5.0)), num_threads=1)
    assert walker.parameters == {
        "timestep_s": 0.015,
        "hip_low_deg": -25.0,
        "hip_high_deg": 5.0,
        "knee_low_deg": -70.0,
        "knee_high_deg": -2.0,
    }


def test_other_ranges_give_commands_other_targets() -> None:
    narrow, action = CommandRanges(hip_deg=(-25.0, 5.0)), torch.tensor([[1.0, 0.2, -1.0, 0.4]])
    landed = HumanoidWalker2d(1, ranges=narrow, num_threads=1).step(action)
    plain = HumanoidWalker2d(1, num_threads=1)
    # 5 and -25 degrees are 55 and 25 of the 70 degrees from -50 to 20.
    same = torch.tensor([[2 * 55 / 70 - 1, 0.2, 2 * 25 / 70 - 1, 0.4]])
    torch.testing.assert_close(landed, plain.step(same), atol=1e-5, rtol=1e-5)


def test_a_correction_says_what_touches_as_the_humanoids_feet_do() -> None:
    """A humanoid that stands touches the floor with feet that are too high for it in the plane."""
    walker = HumanoidWalker2d(3, num_threads=1)
    landed = walker.state.clone()
    landed[:, 0] += torch.tensor([0.0, 0.1, -0.1])
    landed[:, 13:] = torch.tensor([[0.3, -0.2], [1.1, 0.7], [0.49, 0.51]])
    settled = walker.settle(walker.state, landed)
    assert torch.equal(settled[:, :13], landed[:, :13])
    assert settled[:, 13:].tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    assert torch.equal(walker.state, settled)
