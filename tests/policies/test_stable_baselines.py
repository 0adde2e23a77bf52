"""Stable-Baselines3 in vector environments of the package."""

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecMonitor

import astra_data.envs  # noqa: F401
from astra_data.policies.stable_baselines import StableBaselinesEnv


def test_rows_are_those_of_the_vector_environment() -> None:
    """The same seed, through Stable-Baselines3's own monitor and by Gymnasium's interface."""
    shown, truth = (gymnasium.make_vec("astra_data/PointMazeUMaze-v0", num_envs=3) for _ in range(2))
    rows = VecMonitor(StableBaselinesEnv(shown))
    shown.reset(seed=5), truth.reset(seed=5)
    rng, lengths, ages = np.random.default_rng(0), [], np.zeros(3, dtype=int)
    for _ in range(705):  # an episode has 700 steps at most
        action = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        observation, reward, done, infos = rows.step(action)
        expected = truth.step(action)
        ages += 1
        np.testing.assert_array_equal(observation, expected[0])
        np.testing.assert_array_equal(reward, expected[1].astype(np.float32))
        np.testing.assert_array_equal(done, expected[2] | expected[3])
        for row in np.flatnonzero(done):
            final = expected[4]["final_obs"][row]
            np.testing.assert_array_equal(infos[row]["terminal_observation"], final)
            assert infos[row]["TimeLimit.truncated"] == bool(expected[3][row] and not expected[2][row])
            assert infos[row]["episode"]["l"] == ages[row]
            lengths.append(ages[row])
            ages[row] = 0
    assert len(lengths) >= 3


def test_who_ends_in_the_last_moment_is_not_timed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gymnasium.make_vec("astra_data/PointMazeUMaze-v0", num_envs=3)
    rows, zeros = StableBaselinesEnv(env), np.zeros((3, 8), np.float32)
    ended, late = np.array([True, True, False]), np.array([True, False, True])
    monkeypatch.setattr(env, "step", lambda _: (zeros, zeros[:, 0], ended, late, {"final_obs": zeros}))
    _, _, done, infos = rows.step(np.zeros((3, 2), np.float32))
    assert done.all() and [info["TimeLimit.truncated"] for info in infos] == [False, False, True]
