from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecMonitor

import astra_data.envs
from astra_data.core.errors import BadInputError
from astra_data.grounding.history import HistoryGrounding, ScatterModel, ScatterShape
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.gymnasium import Array, BatchedVectorEnv, SeededSimulatorEnv, SingleEnv
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.robots.registry import TASKS
from astra_data.worlds.user_code import user_object

gymnasium.register_envs(astra_data.envs)
SB3_PPO = Path(__file__).parents[2] / "recipes/examples/methods/sb3_ppo.py"
StableBaselinesEnv = user_object(f"{SB3_PPO}:StableBaselinesEnv")

NAMES = [f"astra_data/{world}{maze}-v0" for world in ("AntMaze", "PointMaze") for maze in ("UMaze", "Long")]


def point_mazes(num_envs: int, max_episode_steps: int) -> BatchedVectorEnv:
    env = gymnasium.make_vec(
        NAMES[2], num_envs=num_envs, vectorization_mode="vector_entry_point", max_episode_steps=max_episode_steps
    )
    assert isinstance(env, BatchedVectorEnv)
    return env


def goal_ward(observation: Array) -> Array:
    """Return commands that turn a point mass around the inner wall of the U."""
    x, y = observation[:, 0] * 10, observation[:, 1] * 10
    east, west = (y > 2.5) & (x < 3), y < -2.5
    command = np.zeros((len(observation), 2), dtype=np.float32)
    command[east, 0], command[west, 0] = 1, -1
    command[~east & ~west, 1] = -1
    command[west, 1] = (observation[west, 5] - observation[west, 1]).clip(-0.1, 0.1) * 10
    return command


def test_failures_are_told_apart_from_successes() -> None:
    task = TASKS["antmaze-umaze"]
    walls = replace(task.objective, ends_at_walls=True)
    simulator = NO_GROUNDING.simulator(task, 2)
    simulator.simulator.period_s = torch.tensor(0.05, requires_grad=True)  # type: ignore[union-attr] # as if learned
    env = BatchedVectorEnv(SeededSimulatorEnv(SimulatorEnv(walls, simulator)), max_episode_steps=200)
    env.reset(seed=0)
    commands = np.array([[0.0, 0.0], [-1.0, 1.0]], dtype=np.float32)
    for _ in range(100):
        *_, terminated, _, infos = env.step(commands)
        if terminated.any():
            break
    assert terminated.tolist() == [False, True] and infos["final_info"]["failed"].tolist() == [False, True]
    assert not infos["failed"].any() and not infos["final_info"]["success"].any()
    one, beside = SimulatorEnv(walls, simulator), torch.tensor([[-5.99, 4.0, -1.0, 0.0]] * 2)
    one.start_from(beside, torch.tensor([[-6.0, 4.0], [4.0, 4.0]]), torch.arange(2))
    step = one.step(torch.tensor([[-1.0, 0.0]] * 2))
    assert simulator.blocked.all() and step.success.tolist() == [True, False] and one.failed.tolist() == [False, True]


@pytest.mark.filterwarnings("ignore:.*infinity")
@pytest.mark.parametrize("name", NAMES)
def test_gymnasiums_own_checks_pass(name: str) -> None:
    env = gymnasium.make(name)
    assert isinstance(env.unwrapped, SingleEnv) and env.observation_space.shape == ((31,) if "Ant" in name else (8,))
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (2,))
    check_env(env.unwrapped, skip_render_check=True)


def test_actions_that_would_be_spread_over_the_rows_are_refused() -> None:
    env, one = point_mazes(4, 10), gymnasium.make(NAMES[2])
    env.reset(seed=0), one.reset(seed=0)
    for action in (np.ones(2), np.ones((4, 1)), np.full((4, 2), np.nan)):
        for stepped, given in ((env, action), (one, action[0])):
            with pytest.raises(BadInputError, match=r"^action: expected (finite|shape)"):
                stepped.step(given)


def test_noise_comes_from_the_seed_and_differs_from_step_to_step() -> None:
    task = TASKS["antmaze-umaze"]
    model = GroundingModel(GroundingShape(state_size=4, action_size=2, goal_size=2, latent_size=16))
    inputs = 16 + 2 + model.state_features(torch.zeros(1, 4)).shape[1]
    scatters = ScatterModel(ScatterShape(inputs, 4, 50))
    scatters.forms.copy_(torch.randn(50, 4))
    simulator = HistoryGrounding(model, scatter_model=scatters).simulator(task, 1)
    env = SeededSimulatorEnv(SimulatorEnv(task.objective, simulator))

    def velocities(seed: int) -> list[list[float]]:
        env.reseed(seed)
        env.reset()
        shown = []
        for _ in range(2):
            env.step(torch.zeros(1, 2))
            shown.append(simulator.state[0, 2:].tolist())
            simulator.state[0, 2:] = 0.0
        return shown

    one, again, other = (velocities(seed) for seed in (1, 1, 2))
    assert one == again and one[0] != one[1] and one[0] != other[0]


def test_the_vector_env_speaks_as_gymnasiums_own() -> None:
    ours = point_mazes(2, max_episode_steps=700)
    theirs = gymnasium.make_vec(
        NAMES[2], num_envs=2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}
    )
    for env in (ours, theirs):
        observation, infos = env.reset(seed=1)
        facts = ("success", "failed", "wall_contact")
        assert set(infos) == {*facts, *(f"_{fact}" for fact in facts)}
        successes = 0
        for _ in range(500):
            observation, rewards, terminated, _, infos = env.step(goal_ward(observation))
            if terminated.any():
                rows = np.flatnonzero(terminated)
                final = infos["final_info"]
                assert final["success"][rows].all() and not infos["success"][rows].any() and (rewards[rows] > 9).all()
                np.testing.assert_array_equal(infos["_final_obs"], terminated)
                np.testing.assert_array_equal(final["_success"], terminated)
                assert infos["final_obs"][rows[0]].shape == (8,) and infos["final_obs"].dtype == object
                assert all(infos["final_obs"][row] is None for row in np.flatnonzero(~terminated))
                assert np.abs(observation[rows[0]] - infos["final_obs"][rows[0]]).max() > 0.5  # it starts anew
                successes += len(rows)
        assert successes == 2


def test_a_grounded_simulator_shows_its_latents() -> None:
    task = TASKS["antmaze-umaze"]
    model = GroundingModel(GroundingShape(state_size=4, action_size=2, goal_size=2, latent_size=16))
    grounded = HistoryGrounding(model.requires_grad_(False)).simulator(task, 3)
    env = BatchedVectorEnv(SeededSimulatorEnv(SimulatorEnv(task.objective, grounded)), max_episode_steps=5)
    raw = point_mazes(3, max_episode_steps=5)
    first, _ = env.reset(seed=1)
    expected, _ = raw.reset(seed=1)
    assert env.observation_space.shape == (3, 16 + 8)
    for _ in range(4):
        # An untrained model corrects nothing: behind the latents lies what the raw simulator shows.
        np.testing.assert_allclose(first[:, 16:], expected, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(first[:, :16], axis=1), 1.0, rtol=1e-3)
        command = np.full((3, 2), 0.5, dtype=np.float32)
        first, expected = env.step(command)[0], raw.step(command)[0]
    ends = [env.step(command)[3].all() for _ in range(7)]
    assert ends == [True, False, False, False, False, True, False]  # each episode has five steps


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
