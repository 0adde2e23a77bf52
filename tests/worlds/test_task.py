import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from small_cart import GIVEN, LOGS_ALONE, TASK, Rail, Reach

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE, Column
from astra_data.methods.follower import careful
from astra_data.robots.registry import TASKS
from astra_data.worlds.commands import DrivenSimulator
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.task import ColumnEntry, Task, column, free_body, names_with_units


def test_entries_become_a_column() -> None:
    place = column("place", [ColumnEntry(name, "m", "world", "position") for name in ("a", "b")], "where it is")
    assert place.names == ("a", "b") and place.meaning == "where it is"
    assert place.astra == {"unit": ["m", "m"], "frame": ["world"] * 2, "role": ["position"] * 2}


def test_names_end_with_units_where_they_do_not_yet() -> None:
    units = ["m/s", "°", "1", "", "m"]
    state = Column("state", size=5, names=("v", "tilt", "share", "n", "x_m"), astra={"unit": units})
    assert names_with_units(state) == ["v_m_s", "tilt_deg", "share", "n", "x_m"]
    assert names_with_units(Column("state", size=2)) == ["0", "1"]


def test_a_free_body_has_position_attitude_joints_and_their_rates() -> None:
    state = column("state", free_body(("left", "right")), "qpos and qvel")
    assert [state.labels[index] for index in (7, 8, 15, 16)] == ["left", "right", "left_rate", "right_rate"]
    assert state.size == 17 and state.units[15:] == ["rad/s"] * 2
    assert [(role, group.start) for role, group in state.roles if role != "invariant"] == [
        *(("position", 0), ("quaternion", 3), ("vector", 9))
    ]


ANT, WALKER, KICK = (TASKS[name] for name in ("antmaze-umaze", "humanoid-walker2d", "nao-kick"))


def test_what_needs_a_maze_is_refused_where_there_is_none() -> None:
    assert ANT.maze is ANT.plane is U_MAZE
    asked: list[Callable[[], object]] = [lambda: WALKER.maze, lambda: careful(WALKER, torch.zeros(1, 0))]
    for ask in asked:
        with pytest.raises(BadInputError, match=r"a task in a maze, got 'humanoid-walker2d'.*leave out"):
            ask()


def test_six_fields_make_a_task() -> None:
    task = Task(**GIVEN)
    assert task.instruction == "rail-cart" and task.simulator_id == "Rail" and task.fps == 10
    assert [(column.name, column.size, column.names) for column in task.state_columns] == [
        ("observation.state", 2, ("x", "speed")),
        ("observation.environment_state", 1, None),
        ("action", 1, ("v",)),
        ("next.observation.state", 2, ("x", "speed")),
    ]
    assert task.abstract_state.name == "abstract.state" and task.quantities == {"x": (0,)}
    state = torch.tensor([[3.0, 4.0]])
    assert task.abstraction(state).tolist() == [[3.0]] and torch.equal(task.beyond(state), state)
    assert not task.has_target and TASK.has_target and ANT.has_target
    assert replace(task, name="other").commands == task.commands


class HalfRail(Rail):
    """Another simulator, with names and φ of its own."""

    abstract_state = Column("abstract.state", size=1, names=("half",))

    @staticmethod
    def abstraction(state: Any) -> Any:
        return 0.5 * state[..., :1]


def test_what_was_filled_in_is_filled_in_anew_where_a_field_is_replaced() -> None:
    other = replace(TASK, make_simulator=HalfRail, commands={"push": (0.0, 1.0)}, name="half")
    state = torch.tensor([[4.0, 1.0]])
    assert other.abstraction(state).tolist() == [[2.0]] and TASK.abstraction(state).tolist() == [[4.0]]
    assert (other.simulator_id, other.action.names, other.instruction) == ("HalfRail", ("push",), "half")
    assert other.abstract_state.names == ("half",) and list(other.quantities) == ["half"]
    back = replace(other, make_simulator=Rail)
    assert back.simulator_id == "Rail" and back.abstraction is Rail.abstraction


def test_columns_are_called_as_in_datasets_whatever_a_task_calls_them() -> None:
    given = {"state": Column("states", size=2), "action": Column("act", size=1), "goal": Column("to", size=1)}
    task = Task(**GIVEN | given)
    assert [column.name for column in task.state_columns] == [STATE, GOAL, ACTION, NEXT_STATE]


def test_what_was_given_stays_where_a_field_is_replaced() -> None:
    given: dict[str, Any] = {
        "abstraction": lambda state: state[..., 1:],
        "abstract_state": Column("any", size=1, names=("speed",)),
        "action": Column("action", size=1, names=("push",)),
        "instruction": "go",
        "quantities": {"speed_m_s": (0,)},
        "simulator_id": "mine",
    }
    for task in (Task(**GIVEN | given), replace(TASK, **given)):
        other = replace(task, make_simulator=HalfRail, commands={"v": (0.0, 1.0)}, name="half")
        for name in given.keys() - {"abstract_state"}:
            assert getattr(other, name) is given[name]
        assert other.abstract_state == replace(given["abstract_state"], name="abstract.state")


@pytest.mark.parametrize("given", [(), (0,), (1, 0), (0, 2), (-2, -1), (0, 1), (0, 1, 2), (2, 3, 4)])
def test_a_ball_is_at_two_indices_in_a_row(given: tuple[int, ...]) -> None:
    wanted = "quantities: ball_position_m: expected two indices in a row, of x and y, after the robot's, got "
    with pytest.raises(BadInputError, match=wanted + re.escape(str(given))):
        replace(ANT, quantities={"ball_position_m": given})
    kick = TASKS["nao-kick"]
    others = ({"ball_position_m": (4, 5)}, {"ball_position_m": (4, 5), "ball_velocity_m_s": (5, 6)})
    assert kick.ball_rolls and not any(replace(kick, quantities=each).ball_rolls for each in others)
    assert replace(ANT, quantities={"ball_position_m": (2, 3)}).ball_index == 2 and ANT.ball_index is None


def test_a_ball_on_a_beam_has_no_place_in_a_plane() -> None:
    class Beam(Rail):
        abstract_state = Column("abstract.state", size=1, names=("ball_position",), astra={"unit": ["m"]})

    task = replace(TASK, make_simulator=Beam)
    assert task.quantities == {"ball_position_m": (0,)} and task.ball_index is None
    assert replace(task, name="beam").ball_index is None


def test_what_a_user_calls_a_maze_is_no_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(TASK.objective), "maze", "a hedge", raising=False)
    assert TASK.plane is None


def test_simulators_of_a_task_take_actions_and_commands() -> None:
    action = torch.tensor([[1.0], [-1.0]])
    torch.testing.assert_close(TASK.simulator(2).step(action), torch.tensor([[0.4], [-0.1]]))
    torch.testing.assert_close(TASK.own_simulator(2).step(action), torch.tensor([[0.1], [-0.1]]))
    assert ANT.simulator(2) is not None and not isinstance(ANT.simulator(2), DrivenSimulator)


class AloneOnTheCpu(Rail):
    """A rail that has all that a task needs of a simulator, and takes no device."""

    blocked = torch.zeros(2, dtype=torch.bool)

    def settle(self, before: torch.Tensor, landed: torch.Tensor) -> torch.Tensor:
        return landed

    def vary(self, parameters: Mapping[str, torch.Tensor]) -> None: ...


def test_states_are_on_the_device_of_the_task_though_the_simulator_takes_none() -> None:
    task = replace(TASK, make_simulator=AloneOnTheCpu, commands={"v": (-1.0, 1.0)})
    assert isinstance(task.simulator(2), AloneOnTheCpu) and task.simulator(2, "meta").state.device.type == "meta"


def test_a_task_without_a_target_says_so() -> None:
    with pytest.raises(BadInputError, match=r"'rail-cart' has no target: give it a `robot`, or leave out"):
        LOGS_ALONE.target(1, seed=0)


UNSIZED = type("Unsized", (Objective,), dict.fromkeys(Objective.__abstractmethods__))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"commands": {"v": (0.0, 1.0), "w": (0.0, 1.0)}}, "objective: action_size 1, expected .* 2"),
        (
            {"commands": {"v": (0.0, 1.0), "w": (0.0, 1.0)}, "action": Column("action", size=2, names=("w", "v"))},
            "action: names w, v, expected v, w$",
        ),
        ({"action": Column("action", size=2)}, "action: 2 values, expected 1"),
        ({"goal": Column("observation.environment_state", size=2)}, "goal: 2 values, expected 1"),
        ({"timestep_s": "0.1"}, "timestep_s: expected a number of seconds, got '0.1'"),
        ({"name": 3}, "name: expected a text, got 3"),
        ({"commands": [(0.0, 1.0)]}, r"commands: expected \(least, largest\) by name, or a dataset, got \[\(0"),
        ({"objective": Reach}, "objective: expected an object of a class .*Objective, got <class"),
        ({"objective": UNSIZED(horizon=9)}, "Unsized: expected an action_size, the number of commands"),
        ({"timestep_s": 2.0}, "timestep_s: expected above 0 and below 2 s.*: got 2.0"),
        ({"name": "my rail"}, "name: expected letters, digits"),
        ({"objective": Reach(horizon=0)}, "objective: horizon 0, expected 1 step or more"),
        (
            {"objective": Reach(horizon=8 / 0.05)},  # type: ignore[arg-type]
            r"objective: horizon 160.0, expected 1 step or more, a whole number, such as round\(8 / ",
        ),
        (
            {"state": Column("observation.state", size=4, names=("x", "v", "v", "x"))},
            "state: names has v, x more than once$",
        ),
        ({"make_simulator": dict}, "dict has no abstraction.*; make_simulator: dict has no abstract_state"),
    ],
)
def test_fields_that_contradict_each_other_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        Task(**GIVEN | wrong)


def test_what_a_class_has_is_found_through_partials() -> None:
    made, usual = Task(**GIVEN | {"make_simulator": partial(partial(Rail))}), Task(**GIVEN | {"make_simulator": Rail})
    assert (made.abstract_state, made.abstraction) == (usual.abstract_state, usual.abstraction)
    assert made.simulator_id == usual.simulator_id == "Rail"
