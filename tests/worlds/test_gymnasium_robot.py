import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.worlds.commands import Commands
from astra_data.worlds.gymnasium_robot import Env, GymnasiumRobot, observed
from astra_data.worlds.robot import State


def torque(command: NDArray[np.float64], state: State) -> NDArray[np.float64]:
    """Push half as hard, and less where the pendulum turns fast."""
    return np.asarray(0.5 * command - 0.1 * state[1])


def angle_and_speed(env: Env, observation: NDArray[np.float64]) -> State:
    return [env.unwrapped.state[0], float(observation[2])]  # type: ignore[attr-defined]


def is_fast(state: State, terminated: bool) -> bool:
    return bool(abs(state[1]) > 2.0)


def test_equals_the_environment_stepped_by_hand() -> None:
    made = partial(
        GymnasiumRobot, "Pendulum-v1", read_state=angle_and_speed, command=torque, failed=is_fast, g=9.0
    )
    robot = pickle.loads(pickle.dumps(made))()
    env = gymnasium.make("Pendulum-v1", g=9.0).unwrapped
    observation, _ = env.reset(seed=4)
    states, fails = [robot.reset(seed=4)], []
    for number in range(230):  # beyond the environment's own limit of 200 steps
        by_hand = np.array([env.state[0], observation[2]])  # type: ignore[attr-defined]
        np.testing.assert_array_equal(states[-1], by_hand)
        command = np.array([4.0 * np.sin(0.3 * number)])
        observation, *_ = env.step(0.5 * command - 0.1 * by_hand[1])
        state, failed = robot.step(command)
        states.append(state)
        fails.append(failed)
        assert failed == (abs(observation[2]) > 2.0)
    assert set(fails) == {True, False}


def test_by_default_states_are_observations_and_the_end_is_a_failure() -> None:
    robot, env = GymnasiumRobot("InvertedPendulum-v5"), gymnasium.make("InvertedPendulum-v5")
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(robot.reset(seed=0), observation)
    ends = []
    for _ in range(10):
        observation, _, terminated, _, _ = env.step(np.array([1.0]))
        state, failed = robot.step(np.array([1.0]))
        np.testing.assert_array_equal(state, observation)
        ends.append(failed)
        assert failed == terminated
        if terminated:
            break
    assert ends[-1] and not ends[0]


def test_an_environment_that_cannot_be_made_is_named() -> None:
    with pytest.raises(BadInputError, match=r"gymnasium.make\('no_such_package:X-v0'\) fails with ModuleNot"):
        GymnasiumRobot("no_such_package:X-v0")
    with pytest.raises(BadInputError, match=r"gymnasium.make\('Pendulum-v77'\) fails with "):
        GymnasiumRobot("Pendulum-v77")


def test_commands_that_are_no_actions_are_refused() -> None:
    robot = GymnasiumRobot("Pendulum-v1")
    robot.check_commands(Commands({"torque": (-2.0, 2.0)}))
    with pytest.raises(
        BadInputError, match=r"-2 to 2 in entry 0, and the command is -2\.1: narrow the task's"
    ):
        robot.check_commands(Commands({"torque": (-2.1, 2.0)}))
    with pytest.raises(BadInputError, match=r"-2 to 2 in entry 0, and the command is 2\.1"):
        robot.check_commands(Commands({"torque": (-2.0, 2.1)}))
    two = Commands({"v": (-1.0, 1.0), "w": (-1.0, 1.0)})
    with pytest.raises(BadInputError, match=r"Pendulum-v1 takes actions of shape \(1,\), got \(2,\): give"):
        robot.check_commands(two)
    robot.reset(seed=0)
    robot.step(np.array([2.0 + 1e-6]))  # what rounding does
    with pytest.raises(BadInputError, match="the command is 3"):
        robot.step(np.array([3.0]))


def test_a_function_of_commands_may_go_beyond_what_the_environment_clips() -> None:
    robot = GymnasiumRobot("Pendulum-v1", command=torque)
    robot.check_commands(Commands({"torque": (-9.0, 9.0)}))


def test_an_observation_of_several_entries_needs_a_function_that_reads_it() -> None:
    with pytest.raises(BadInputError, match="the environment shows place, speed: give GymnasiumRobot a read"):
        observed(GymnasiumRobot("Pendulum-v1").env, {"place": np.zeros(2), "speed": np.zeros(1)})
