import re
from pathlib import Path

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.exchange.csv_numbers import plain_name, read_numbers

RUN = re.compile("run_id")


def test_fields_are_numbers_flags_and_what_is_neither(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text(
        "x,flag,Run ID,name,date,gap\n1.5,true,b,b,2024-01-01,\n2,false,a,a,2024-01-02, \n3,true,b,b,,4\n"
    )
    found = read_numbers(log, RUN)
    expected = {
        "x": [1.5, 2.0, 3.0],
        "flag": [1.0, 0.0, 1.0],
        "Run ID": [1.0, 0.0, 1.0],  # numbered, as its plain name is one of those
        "name": [np.nan] * 3,
        "date": [np.nan] * 3,
        "gap": [np.nan, np.nan, 4.0],
    }
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_days_tell_episodes_apart_unless_one_is_missing(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    for third, numbers in (("2024-01-02", [1.0, 0.0, 1.0]), ("", [np.nan] * 3)):
        log.write_text(f"x,run_id\n1,2024-01-02\n2,2024-01-01\n3,{third}\n")
        np.testing.assert_array_equal(read_numbers(log, RUN)["run_id"], numbers)


def test_a_log_of_texts_alone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("run_id,name\na,b\nc,\n")
    read_numbers(tmp_path / "log.csv", RUN)  # which tells episodes apart
    with pytest.raises(BadInputError, match="rows of numbers below it, parted by commas"):
        read_numbers(tmp_path / "log.csv", re.compile("other"))


def test_plain_names_are_small_letters_digits_and_single_underscores() -> None:
    assert [plain_name(name) for name in ("Run ID", "pose.x [m]", "θ", "_a__B2", "yaw°/s")] == [
        "run_id",
        "pose_x_m",
        "",
        "a_b2",
        "yaw_deg_s",
    ]
