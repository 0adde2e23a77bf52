import sys
from pathlib import Path

import pytest
from damaged import EPISODES, alter, drop
from fake_dataset import COLUMNS, fake_episodes, write_fake, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Column, Episode
from astra_data.dataset.doctor.check import Report
from astra_data.dataset.doctor.lerobot_loader import compare_with_lerobot

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")  # set by the function, and restored here


def compared(root: Path, episodes: int = 5, frames: int = 55) -> list[str]:
    report = Report(episodes, frames)
    compare_with_lerobot(root, report)
    return report.faults


def test_lerobot_reads_the_same_windows(tmp_path: Path) -> None:
    import datasets.config  # noqa: PLC0415 - slow

    usual = datasets.config.HF_DATASETS_CACHE
    with writer(tmp_path / "set", columns=[*COLUMNS, Column("observation.count", "int64")]) as out:
        for one in fake_episodes():
            counted = {**one.columns, "observation.count": one.columns["mode"]}
            out.add(Episode(one.uid, counted, one.metadata))
    assert compared(tmp_path / "set") == []
    assert usual == datasets.config.HF_DATASETS_CACHE


@pytest.mark.parametrize(
    ("column", "episode", "value", "row"), [("dataset_from_index", 0, 1, 0), ("dataset_to_index", 4, 54, 54)]
)
def test_other_boundaries_of_episodes_are_found(
    column: str, episode: int, value: int, row: int, tmp_path: Path
) -> None:
    root = write_fake(tmp_path / "set").root
    # lerobot takes boundaries from meta/episodes: the first begins, or the last ends, a step off.
    alter(EPISODES, column, episode, value)(root)
    faults = compared(root)
    for name in ("observation.state", "action"):
        for other in ("values", "padding"):
            assert f"lerobot's window of {name} around row {row} has other {other}" in faults


def test_what_lerobot_cannot_open_is_a_fault(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    drop("meta/tasks.parquet")(root)
    [fault] = compared(root)
    assert fault.startswith("lerobot cannot open it: ")


def test_without_lerobot_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(BadInputError, match=r"lerobot is needed but not installed: uv sync --extra lerobot"):
        compared(write_fake(tmp_path / "set").root)
