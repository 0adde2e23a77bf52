import mujoco
import numpy as np
import pytest
import torch

from astra_data.robots.humanoid.model import COMMANDED, FEET, STANDING, TIMESTEP_S, Locomotion, humanoid_model
from astra_data.robots.humanoid.target import HumanoidEnv
from astra_data.robots.humanoid.tasks import JointWalking, MassWalking, PlanarWalking, Walking
from astra_data.robots.humanoid.walker2d import walker_model

KINDS = (PlanarWalking, JointWalking, MassWalking)
NOTHING = torch.zeros(3, 0)


def made(kind: type[Walking]) -> Walking:
    return kind(horizon=5)


@pytest.mark.parametrize("kind", KINDS)
def test_starts_are_the_targets(kind: type[Walking]) -> None:
    env = HumanoidEnv(Locomotion(), 3, seed=4, num_threads=1)
    env.reset()
    starts = made(kind).draw_starts(np.random.default_rng(4), 3)
    expected = made(kind).abstracted(env.state.double().numpy())
    np.testing.assert_allclose(starts, expected, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_policy_sees_of_random_motion_is_about_one_long(kind: type[Walking]) -> None:
    env = HumanoidEnv(Locomotion(), 8, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        env.step(2 * torch.rand(8, 4, generator=generator) - 1)
    state = torch.from_numpy(made(kind).abstracted(env.state.numpy()))
    seen = made(kind).observe(state, torch.zeros(8, 0))
    assert seen.shape == state.shape
    lengths = seen.abs().mean(0)
    assert bool(((lengths > 0.1) & (lengths < 3.0)).all()), lengths


@pytest.mark.parametrize("kind", KINDS)
def test_to_last_is_to_succeed(kind: type[Walking]) -> None:
    objective, failed = made(kind), torch.tensor([True, False])
    state = torch.from_numpy(objective.draw_starts(np.random.default_rng(0), 2))
    reached = objective.reached(state, torch.zeros(2, 0))
    assert objective.succeeded(reached, failed, 4).tolist() == [False, False]
    assert objective.succeeded(reached, failed, 5).tolist() == [False, True]


@pytest.mark.parametrize(
    ("kind", "bias", "scatter", "early"), [(PlanarWalking, 0.1, 0.8, 0.0), (MassWalking, 0.03, 0.05, 4.0)]
)
def test_pay_and_falls_are_the_targets_but_for_costs(
    kind: type[Walking], bias: float, scatter: float, early: float
) -> None:
    """Of what the humanoid does under random commands; `early`: steps by which falls are told too early.

    `scatter` is of the steps after which it looks along x, as it is paid there and as simulators take it to.
    """
    env = HumanoidEnv(Locomotion(effort_cost=0.0, contact_cost=0.0), 32, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    objective, alive = made(kind), torch.ones(32, dtype=torch.bool)
    wrong, astray, misjudged = [], [], []
    for number in range(80):
        if number % 7 == 0:
            action = 2 * torch.rand(32, 4, generator=generator) - 1
        states = [env.state.numpy()]
        step = env.step(action)
        states.append(env.state.numpy())
        before, after = (torch.from_numpy(objective.abstracted(state))[alive] for state in states)
        failed = objective.missed(after, NOTHING)
        judged_alike = failed == step.terminated[alive]
        paid = objective.reward(before, after, NOTHING, failed)
        wrong.append((paid - step.reward[alive])[judged_alike])
        w, x, y, z = torch.from_numpy(states[1])[alive][judged_alike, 3:7].unbind(-1)
        astray.append(torch.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)).abs())
        misjudged.append(~judged_alike)
        alive &= ~step.terminated
    assert int(alive.sum()) < 8
    assert abs(float(torch.cat(wrong).mean())) < bias
    straight = torch.cat(astray) < 0.03
    assert straight.float().mean() > 0.05
    assert float(torch.cat(wrong)[straight].square().mean().sqrt()) < scatter
    assert float(torch.cat(misjudged).sum()) / 32 <= early


def test_the_walkers_mass_moves_as_mujoco_says() -> None:
    objective, model = PlanarWalking(horizon=5), walker_model()
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    data.qpos[1:], data.qvel[:] = [1.4, 0.3, -0.4, -1.0, 0.2, -0.5], generator.normal(size=7)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    after = torch.zeros(1, 15)
    after[0, :13] = torch.from_numpy(np.concatenate([data.qpos[1:], data.qvel]))
    assert float(objective.velocity(after, after)) == pytest.approx(data.subtree_linvel[0, 0], abs=1e-5)


def test_joints_are_paid_for_the_way_of_the_torso_over_the_lower_foot() -> None:
    objective, model = JointWalking(horizon=5), humanoid_model()
    data = mujoco.MjData(model)
    # The left knee is drawn up, so that the right foot is the lower one; then both hips turn.
    poses = np.zeros((2, 17))
    poses[:, COMMANDED[1]] = -1.0
    poses[1, [COMMANDED[0], COMMANDED[2]]] = 0.02, 0.1
    feet = []
    for pose in poses:
        data.qpos[:] = STANDING[:24]
        data.qpos[7:] = pose
        mujoco.mj_forward(model, data)
        feet.append([data.geom(name).xpos.copy() for name in FEET])
    (left, right), (_, later) = feet
    assert right[2] < left[2]
    velocity = (right[0] - later[0]) / TIMESTEP_S
    before, after = torch.zeros(2, 1, 34)
    before[0, :17], after[0, :17] = torch.from_numpy(poses).float()
    reward = objective.reward(before, after, NOTHING[:1], torch.zeros(1, dtype=torch.bool))
    assert abs(velocity) > 1.0
    assert float(reward) == pytest.approx(5.0 + 1.25 * velocity, rel=1e-4)
    assert not objective.missed(after, NOTHING[:1]).any()


def test_a_center_of_mass_near_the_floor_has_fallen() -> None:
    objective = MassWalking(horizon=5)
    lying = np.tile(STANDING, (3, 1))
    lying[1, 2], lying[1, 3:7] = 0.2, [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]  # on its back
    lying[2, 24] = 2.0
    state = torch.from_numpy(objective.abstracted(lying))
    failed = objective.missed(state, NOTHING)
    assert failed.tolist() == [False, True, False]
    assert objective.missed(state * torch.nan, NOTHING).all()  # as what no simulator comes back from
    reward = objective.reward(state, state, NOTHING, failed)
    np.testing.assert_allclose(reward.numpy(), [5.0, 0.0, 5.0 + 1.25 * 2.0], atol=1e-6)


def test_torsos_that_are_low_high_or_nowhere_have_fallen() -> None:
    state = torch.zeros(7, 15)
    state[:, 0] = torch.tensor([0.99, 1.0, 1.01, 1.99, 2.0, 2.01, torch.nan])
    failed = PlanarWalking(horizon=5).missed(state, torch.zeros(7, 0))
    assert failed.tolist() == [True, True, False, False, True, True, True]


def test_how_low_a_mass_may_be_is_an_option() -> None:
    state = torch.zeros(3, 46)
    state[:, 36] = torch.tensor([0.74, 0.75, 0.76])
    failed = MassWalking(horizon=5, lowest_mass_m=0.75).missed(state, NOTHING)
    assert failed.tolist() == [True, False, False]
