from pathlib import Path

import numpy as np
import pytest

from astra_data.dataset.columns import ACTION, STATE, Column, Episode
from astra_data.dataset.compare import column_faults, names_apart
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter


def recorded(folder: Path, names: tuple[str, ...] | None, units: list[str] | None = None) -> Dataset:
    astra = None if units is None else {"unit": units}
    columns = [Column(STATE, size=2, names=names, astra=astra), Column(ACTION, names=("throttle",))]
    description = {"name": "logs", "stage": "import"}
    with DatasetWriter(folder, columns, fps=10, task="drive", description=description) as writer:
        writer.add(Episode(0, {STATE: np.zeros((3, 2), np.float32), ACTION: np.zeros(3, np.float32)}))
    return Dataset.open(folder)


@pytest.mark.parametrize(
    ("expected", "faults"),
    [
        (Column(STATE, size=2, names=("x", "v"), astra={"unit": ["m", "m/s"]}), []),
        (Column(STATE, size=2, names=("a", "b")), []),
        (Column(STATE, size=3), ["observation.state has 2 values, expected those of cart: 3"]),
        (Column("force"), ["has no column force"]),
        (
            Column(STATE, size=2, names=("v", "x")),
            ["has the values x, v in observation.state, expected the order v, x"],
        ),
        (
            Column(STATE, size=2, names=("x", "v"), astra={"unit": ["mm", "m/s"]}),
            ["has x of observation.state in m, expected mm: scale it on import"],
        ),
    ],
)
def test_what_contradicts_a_column_is_a_fault(tmp_path: Path, expected: Column, faults: list[str]) -> None:
    logs = recorded(tmp_path / "logs", ("x", "v"), ["m", "m/s"])
    assert column_faults(logs, expected, "cart") == faults


@pytest.mark.parametrize(
    ("names", "expected", "told"),
    [
        (("heading", "north"), ("x", "v"), "heading, north"),
        (("heading", "x"), ("x", "v"), ""),
        (("heading", "north"), None, ""),
        (None, ("x", "v"), "values without names"),
        (None, None, ""),
    ],
)
def test_names_of_which_none_agrees_are_told(
    tmp_path: Path, names: tuple[str, ...] | None, expected: tuple[str, ...] | None, told: str
) -> None:
    logs = recorded(tmp_path / "logs", names)
    columns = [Column(STATE, size=2, names=expected), Column(ACTION, names=("throttle",))]
    text = f"logs@data-1.0.0: takes {told} of observation.state as x, v of cart: check that they are, "
    assert names_apart(logs, columns, "cart") == (f"{text}in this order" if told else "")
