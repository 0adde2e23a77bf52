import pytest

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Column
from astra_data.worlds.column_entries import (
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
    mirrored = column("angle", [ColumnEntry("a", "rad", "joint", "invariant", "-a")], "how it stands")
    assert mirrored.astra is not None and mirrored.astra["mirror"] == ["-a"]


def test_a_free_body_is_mirrored_by_its_joints() -> None:
    state = column("state", free_body(("left", "right"), ("-right", "-left")), "qpos and qvel")
    assert state.size == 17
    assert state.mirror is not None
    source, sign = state.mirror
    assert [state.labels[index] for index in (7, 8, 15, 16)] == ["left", "right", "left_rate", "right_rate"]
    assert [source[index] for index in (7, 8, 15, 16)] == [8, 7, 16, 15]
    assert [state.labels[index] for index in range(17) if sign[index] < 0] == [
        *("left", "right", "wx", "wz", "left_rate", "right_rate")
    ]
    plain = column("state", free_body(("left", "right")), "qpos and qvel")
    assert plain.mirror is None and plain.astra is not None and "mirror" not in plain.astra
    assert (plain.names, plain.units, plain.roles) == (state.names, state.units, state.roles)


def test_a_mirror_image_that_no_entry_has_is_refused() -> None:
    with pytest.raises(BadInputError, match="mirror '-right' of left"):
        column("state", free_body(("left",), ("-right",)), "qpos and qvel")


def test_names_end_with_units_where_they_do_not_yet() -> None:
    units = ["m/s", "°", "1", "", "m"]
    state = Column("state", size=5, names=("v", "tilt", "share", "n", "x_m"), astra={"unit": units})
    assert names_with_units(state) == ["v_m_s", "tilt_deg", "share", "n", "x_m"]
    assert names_with_units(Column("state", size=2)) == ["0", "1"]


def test_names_that_several_values_have_are_told_once() -> None:
    assert repeated_names(Column("state", size=5, names=("x", "v", "x", "v", "x"))) == ["v", "x"]
    assert repeated_names(Column("state", size=2, names=("x", "v"))) == []
    assert repeated_names(Column("state", size=2)) == repeated_names(None) == []
