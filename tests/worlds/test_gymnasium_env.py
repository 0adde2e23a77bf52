import pickle
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from small_cart import TASK, Near

from astra_data.core.errors import BadInputError
from astra_data.worlds.commands import Commands
from astra_data.worlds.gymnasium_env import Env, GymnasiumRobot, GymnasiumSimulator, observed
from astra_data.worlds.task import RobotEnv, State


def torque(command: NDArray[np.float64], state: State) -> NDArray[np.float64]:
    """Push half as hard, and less where the pendulum turns fast."""
    return np.asarray(0.5 * command - 0.1 * state[1])


def angle_and_speed(env: Env, observation: NDArray[np.float64]) -> State:
    return [env.unwrapped.state[0], float(observation[2])]  # type: ignore[attr-defined]


def is_fast(state: State, terminated: bool) -> bool:
    return bool(abs(state[1]) > 2.0)


def test_equals_the_environment_stepped_by_hand() -> None:
    made = partial(GymnasiumRobot, "Pendulum-v1", read_state=angle_and_speed, command=torque, failed=is_fast, g=9.0)
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


def test_an_environment_may_be_given_by_its_class() -> None:
    by_id = GymnasiumRobot("Pendulum-v1", g=9.0)
    by_class = GymnasiumRobot(type(by_id.env.unwrapped), g=9.0)
    assert by_class.name == "PendulumEnv"
    np.testing.assert_array_equal(by_class.reset(seed=4), by_id.reset(seed=4))
    moved, pushed = (robot.step(np.array([1.0]))[0] for robot in (by_class, by_id))
    np.testing.assert_array_equal(moved, pushed)
    with pytest.raises(BadInputError, match=r"^making PendulumEnv fails with TypeError.*gravity"):
        GymnasiumRobot(type(by_id.env.unwrapped), gravity=9.0)


class Mirrored(gymnasium.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return -action


def test_wrappers_stay() -> None:
    plain = GymnasiumRobot("Pendulum-v1")
    mirrored = GymnasiumRobot(lambda: Mirrored(gymnasium.make("Pendulum-v1")), read_state=angle_and_speed)
    states = [robot.reset(seed=0) for robot in (plain, mirrored)]
    states = [plain.step(np.array([1.0]))[0], mirrored.step(np.array([-1.0]))[0]]
    assert states[0][2] == states[1][1]


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


class Corridor(gymnasium.Env[Any, Any]):
    """A cart on a rail [x]; episodes end 0.4 m ahead, where it arrives, and 0.4 m behind, where it falls."""

    action_space = gymnasium.spaces.Box(-1.0, 4.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.x = 0.0
        return [self.x, 0.0], {}

    def step(self, action: NDArray[np.float64]) -> Any:
        self.x += 0.1 * float(action[0])
        return [self.x, float(action[0])], 0.0, abs(self.x) >= 0.4, False, {}


def corridor(**functions: Any) -> RobotEnv:
    gymnasium.registry.pop("Corridor-v0", None)
    gymnasium.register("Corridor-v0", Corridor)  # type: ignore[arg-type]
    robot = partial(GymnasiumRobot, "Corridor-v0", **functions)
    env = replace(TASK, robot=robot, objective=Near(horizon=40)).target(2, seed=0)
    assert isinstance(env, RobotEnv)
    env.reset()
    return env


def test_an_end_at_the_goal_is_no_failure_without_a_word() -> None:
    with pytest.raises(BadInputError, match=r"terminated in a step that reached the goal.*GymnasiumRobot a fai"):
        corridor().step(torch.tensor([[0.0], [1.0]]))  # to 0.15 and 0.4 m
    env = corridor()
    for _ in range(4):
        step = env.step(torch.tensor([[-1.0], [-0.6]]))  # by -0.1 and 0 m
    assert env.failed.tolist() == step.terminated.tolist() == [True, False]


def test_commands_that_are_no_actions_are_refused() -> None:
    robot = GymnasiumRobot("Pendulum-v1")
    robot.check_commands(Commands({"torque": (-2.0, 2.0)}))
    with pytest.raises(BadInputError, match=r"-2 to 2 in entry 0, and the command is -2\.1: narrow the task's"):
        robot.check_commands(Commands({"torque": (-2.1, 2.0)}))
    with pytest.raises(BadInputError, match=r"-2 to 2 in entry 0, and the command is 2\.1"):
        robot.check_commands(Commands({"torque": (-2.0, 2.1)}))
    ahead = type("Ahead", (Corridor,), {"action_space": gymnasium.spaces.Box(0.0, np.inf, (1,))})
    with pytest.raises(BadInputError, match=r"takes actions of 0 to inf in entry 0, and the command is -1: nar"):
        GymnasiumRobot(ahead).check_commands(Commands({"v": (-1.0, 1.0)}))
    two = Commands({"v": (-1.0, 1.0), "w": (-1.0, 1.0)})
    with pytest.raises(BadInputError, match=r"Pendulum-v1 takes actions of shape \(1,\), got \(2,\): give"):
        robot.check_commands(two)
    robot.reset(seed=0)
    robot.step(np.array([2.0 + 1e-6]))  # what rounding does
    with pytest.raises(BadInputError, match="the command is 3"):
        robot.step(np.array([3.0]))


def test_an_observation_of_several_entries_needs_a_function_that_reads_it() -> None:
    with pytest.raises(BadInputError, match="the environment shows place, speed: give GymnasiumRobot a read"):
        observed(GymnasiumRobot("Pendulum-v1").env, {"place": np.zeros(2), "speed": np.zeros(1)})


def read(env: Env) -> State:
    state: State = env.state  # type: ignore[attr-defined]
    return state


def write(env: Env, state: State) -> None:
    env.state = state  # type: ignore[attr-defined]


make = partial(GymnasiumSimulator, size=2, read=read, write=write)


def test_every_state_is_stepped_as_by_an_environment_of_its_own() -> None:
    simulator = make(3, env_id="Pendulum-v1", parameters={"gravity": 10.0})
    assert simulator.state.tolist() == [[0.0, 0.0]] * 3 and simulator.parameters == {"gravity": 10.0}
    rng = np.random.default_rng(0)
    states, commands = rng.normal(size=(3, 2)), rng.uniform(-2, 2, (250, 3, 1)).astype(np.float32)
    simulator.reset_to(torch.from_numpy(states).float())
    for command in commands:  # longer than the environment's own episodes
        landed = simulator.step(torch.from_numpy(command))
    for number, state in enumerate(states):
        env = gymnasium.make("Pendulum-v1").unwrapped
        env.reset(seed=number)
        write(env, state)
        for command in commands:
            env.step(command[number])
            write(env, np.asarray(read(env), np.float32))  # as the simulator keeps it
        np.testing.assert_allclose(landed[number].numpy(), read(env), rtol=1e-3)


def test_what_is_written_has_to_be_what_is_read() -> None:
    """Entries in another order, say; after the first step nothing is read twice."""

    for wrong in (lambda env, state: write(env, state[::-1]), lambda env, state: None):
        simulator = make(2, env_id="Pendulum-v1", write=wrong)
        simulator.reset_to(torch.tensor([[0.5, 0.5], [1.0, 0.25]]))
        with pytest.raises(BadInputError, match=r"^Pendulum-v1: after write\(.* expected the same"):
            simulator.step(torch.zeros(2, 1))
    with pytest.raises(BadInputError, match=r"^Pendulum-v1: expected as many commands as actions, Box\(.*: got 2"):
        make(2, env_id="Pendulum-v1").step(torch.zeros(2, 2))
    with pytest.raises(
        BadInputError, match=r"^Pendulum-v1: read\(env\): .* \(2,\), got \(3,\): return 2 values, or give"
    ):
        make(2, env_id="Pendulum-v1", read=lambda env: [*read(env), 0.0]).step(torch.zeros(2, 1))
    reads = []

    def noted(env: Env) -> State:
        reads.append(0)
        return read(env)

    simulator = make(2, env_id="Pendulum-v1", read=noted)
    for expected in (3, 5):
        simulator.step(torch.zeros(2, 1))
        assert len(reads) == expected
