from astra_data.dataset.columns import Column
from astra_data.worlds.task import (
    ColumnEntry,
    column,
    free_body,
    names_with_units,
    repeated_names,
)


def test_entries_become_a_column() -> None:
    place = column(
        "place", [ColumnEntry(name, "m", "world", "position") for name in ("a", "b")], "where it is"
    )
    assert place.names == ("a", "b") and place.meaning == "where it is"
    assert place.astra == {"unit": ["m", "m"], "frame": ["world"] * 2, "role": ["position"] * 2}


def test_names_end_with_units_where_they_do_not_yet() -> None:
    units = ["m/s", "°", "1", "", "m"]
    state = Column("state", size=5, names=("v", "tilt", "share", "n", "x_m"), astra={"unit": units})
    assert names_with_units(state) == ["v_m_s", "tilt_deg", "share", "n", "x_m"]
    assert names_with_units(Column("state", size=2)) == ["0", "1"]


def test_names_that_several_values_have_are_told_once() -> None:
    assert repeated_names(Column("state", size=5, names=("x", "v", "x", "v", "x"))) == ["v", "x"]
    assert repeated_names(Column("state", size=2, names=("x", "v"))) == []
    assert repeated_names(Column("state", size=2)) == repeated_names(None) == []


def test_a_free_body_has_position_attitude_joints_and_their_rates() -> None:
    state = column("state", free_body(("left", "right")), "qpos and qvel")
    assert [state.labels[index] for index in (7, 8, 15, 16)] == ["left", "right", "left_rate", "right_rate"]
    assert state.size == 17 and state.units[15:] == ["rad/s"] * 2
    assert [(role, group.start) for role, group in state.roles if role != "invariant"] == [
        *(("position", 0), ("quaternion", 3), ("vector", 9))
    ]
