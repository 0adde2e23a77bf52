from typing import Any

import gymnasium
import numpy as np
import pytest

from astra_data.robots.humanoid.model import Locomotion
from astra_data.robots.humanoid.target import Humanoids


def theirs(seed: int) -> Any:  # noqa: ANN401 - Gymnasium's own
    env = gymnasium.make("Humanoid-v5").unwrapped
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_equals_gymnasiums_humanoid_step_for_step(scale: float) -> None:
    env = theirs(seed=3)
    rng = np.random.default_rng(0)
    ours = Humanoids(Locomotion(), 3, actuators="motors", num_threads=2)
    state = np.concatenate([env.data.qpos, env.data.qvel])
    ours.reset_to(np.arange(3), np.tile(state, (3, 1)))
    ended = False
    for _ in range(80):
        control = rng.uniform(-0.4 * scale, 0.4 * scale, (3, 17))
        ours.step(control)
        observation, reward, terminated, _, _ = env.step(control[1])
        np.testing.assert_allclose(ours.state[1, 2:], observation[:45], rtol=0, atol=1e-9)
        assert ours.reward[1] == pytest.approx(reward, rel=0, abs=1e-9)
        assert ours.healthy[1] == (not terminated)
        ended |= terminated
    assert ended  # so that both heights were seen
    env.close()


def test_contacts_and_effort_cost() -> None:
    plain, free = Locomotion(), Locomotion(effort_cost=0.0, contact_cost=0.0)
    rewards = []
    for task in (plain, free, Locomotion(contact_cost=1.0)):
        humanoids = Humanoids(task, 1, actuators="motors", num_threads=1)
        humanoids.step(np.full((1, 17), 0.2))
        humanoids.reset_to(np.arange(1), humanoids.state - np.eye(47)[2] * 0.15)  # feet into the floor
        humanoids.step(np.full((1, 17), 0.2))
        rewards.append(humanoids.reward[0])
    paid, unpaid, most = rewards
    assert unpaid - paid > 0.1 * 17 * 0.2**2 + 1e-4
    assert unpaid - most == pytest.approx(0.1 * 17 * 0.2**2 + 10.0)  # clipped


def test_position_control_costs_its_torques_in_units_of_the_motors() -> None:
    humanoids = Humanoids(Locomotion(), 1, num_threads=1)
    state = humanoids.state
    state[0, 2] = 1.8  # off the floor
    humanoids.reset_to(np.arange(1), state)
    humanoids.step(np.full((1, 17), 100.0))  # so far away that every motor gives all it has
    paid = 5.0 - humanoids.reward[0]
    assert paid == pytest.approx(0.1 * 17 * 0.4**2, abs=0.05)


def test_frozen_humanoids_earn_nothing() -> None:
    humanoids = Humanoids(Locomotion(), 2, num_threads=1)
    humanoids.step(np.zeros((2, 17)), np.array([True, False]))
    assert humanoids.reward[0] > 4.0
    assert humanoids.reward[1] == 0.0


def test_who_is_set_anew_has_earned_nothing_yet() -> None:
    humanoids = Humanoids(Locomotion(), 2, num_threads=1)
    humanoids.step(np.zeros((2, 17)))
    kept = humanoids.reward[1]
    humanoids.reset_to(np.array([0]), humanoids.state[:1])
    assert humanoids.reward.tolist() == [0.0, kept] and kept > 4.0


def test_holding_still_falls_forward_as_measured() -> None:
    # 64 of them fell after 78 to 124 steps, 95 in the mean, all forward.
    humanoids = Humanoids(Locomotion(), 24, num_threads=2)
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (24, 47))
    humanoids.reset_to(np.arange(24), humanoids.state + noise)
    steps = np.zeros(24)
    for _ in range(160):
        active = humanoids.healthy
        steps += active
        humanoids.step(np.zeros((24, 17)), active)
    assert not humanoids.healthy.any()
    assert steps.mean() == pytest.approx(95.0, abs=10.0)
    assert steps.min() > 70
    assert (humanoids.state[:, 0] > 0.2).all()
