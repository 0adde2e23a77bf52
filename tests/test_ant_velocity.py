import numpy as np
import pytest
import torch
from ant_velocity import AntVelocityConfig, AntVelocityEnv

from astra_data.robots.ant.body import VelocityController, canonical_view, torques_to_body


def make(num_envs: int = 4, seed: int = 0) -> AntVelocityEnv:
    return AntVelocityEnv(AntVelocityConfig(num_envs=num_envs, num_threads=1), seed=seed)


def test_the_same_seed_gives_the_same_bytes() -> None:
    def run(seed: int) -> bytes:
        env = make(seed=seed)
        values = [env.reset()]
        for _ in range(5):
            step = env.step(torch.full((4, 8), 0.3))
            values += [step.observation, step.reward]
        return b"".join(value.numpy().tobytes() for value in values)

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_observations_are_the_canonical_view() -> None:
    env = make()
    observation = env.reset()
    expected, _ = canonical_view(env.physics.qpos, env.physics.qvel, env.command)
    np.testing.assert_array_equal(observation.numpy(), expected.astype(np.float32))


def test_actions_are_canonical_torques_of_limited_strength() -> None:
    env, twin = make(), make()
    for one in (env, twin):
        one.reset()
    action = torch.rand(4, 8, generator=torch.Generator().manual_seed(0)) * 2 - 1
    _, quarters = canonical_view(twin.physics.qpos, twin.physics.qvel, twin.command)
    env.step(action)
    twin.physics.step(torques_to_body(0.7 * action.numpy().astype(np.float64), quarters))
    np.testing.assert_array_equal(env.physics.qpos, twin.physics.qpos)


def test_commands_are_drawn_and_held() -> None:
    env = make(num_envs=2000)
    env.reset()
    assert (~env.command.any(axis=1)).mean() == pytest.approx(0.15, abs=0.03)
    assert np.abs(env.command).max() <= 1.0
    first = env.command.copy()
    changed = np.zeros(2000, dtype=int)
    for step in range(1, 61):
        before = env.command.copy()
        env.draw_due_commands()
        changes = (env.command != before).any(axis=1)
        changed[changes & (changed == 0)] = step
        if step < 20:
            np.testing.assert_array_equal(env.command, first)
    # Held for 1 to 3 s; a zero may follow a zero unseen.
    seen = changed[changed > 0]
    assert len(seen) > 1900
    assert (seen.min(), seen.max()) == (20, 60)


def test_a_fall_ends_the_episode_and_costs() -> None:
    env = make(num_envs=2)
    env.reset()
    qpos, qvel = env.physics.qpos.copy(), env.physics.qvel.copy()
    qpos[0, 2], qpos[0, 3:7] = 1.0, [0.0, 1.0, 0.0, 0.0]
    env.physics.set_state(np.arange(2), qpos, qvel)
    step = env.step(torch.zeros(2, 8))
    assert step.terminated.tolist() == [True, False]
    assert float(step.reward[0]) == -3.0
    env.reset(step.terminated)
    assert not env.fallen().any()


def test_a_walking_ant_earns_more_than_a_limp_one() -> None:
    env, controller = make(num_envs=16), VelocityController.load()

    def earned(scale: float) -> float:
        env.reset()
        total = 0.0
        for _ in range(40):
            torques = controller(env.physics.qpos, env.physics.qvel, env.command)
            env.physics.step(scale * torques)
            total -= float(env.tracking_error().mean())
        return total

    assert earned(1.0) > earned(0.0) + 4.0
