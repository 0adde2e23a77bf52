import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from failing_disk import small_files
from fake_frames import NAMES, assert_equal, everything

from astra_data.core.errors import CorruptDatasetError, DiskError
from astra_data.dataset.columns import STATE
from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset


def test_mapped_columns_equal_loaded_ones(
    fake: Dataset, frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_CACHE", str(tmp_path))
    mapped = Frames.load(fake, NAMES, memory_share=0.0)
    assert_equal(everything(mapped.windows(5)), everything(frames.windows(5)))
    files = sorted(path.relative_to(tmp_path).parts for path in tmp_path.rglob("*") if path.is_file())
    assert files == [(fake.content_hash, name, "values.npy") for name in sorted(NAMES)]
    # The second time the raw files serve, and what is written to the tensors stays out of them.
    monkeypatch.setattr(Dataset, "blocks", None)
    mapped.columns[STATE].zero_()
    again = Frames.load(fake, NAMES, memory_share=0.0)
    assert torch.equal(again.columns[STATE], frames.columns[STATE])


def test_processes_map_the_same_columns_at_once(fake: Dataset, tmp_path: Path) -> None:
    script = Path(__file__).parents[1] / "mapped_rounds.py"
    command = [sys.executable, *map(str, (script, fake.root, tmp_path))]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    errors = [process.communicate(timeout=120)[1] for process in processes]
    assert errors == [""] * 4
    assert len(list(tmp_path.rglob("values.npy"))) == 2 * 40
    assert not list(tmp_path.rglob(".*"))


def test_a_damaged_raw_file_is_told(fake: Dataset, tmp_path: Path) -> None:
    Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)
    [path] = tmp_path.rglob("values.npy")
    os.truncate(path, 200)
    with pytest.raises(CorruptDatasetError, match=f"{STATE} was altered .*; delete it and try again"):
        Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)


def test_another_value_in_a_raw_file_is_told(fake: Dataset, tmp_path: Path) -> None:
    Frames.load(fake, NAMES, memory_share=0.0, cache=tmp_path)
    path = tmp_path / fake.content_hash / STATE / "values.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CorruptDatasetError, match=f"{STATE} was altered .other values.; delete"):
        Frames.load(fake, NAMES, memory_share=0.0, cache=tmp_path)


def test_a_full_disk_ends_with_an_error_and_no_raw_file(fake: Dataset, tmp_path: Path) -> None:
    with (
        small_files(200),
        pytest.raises(DiskError, match=f"{STATE} cannot be written: a file would be"),
    ):
        Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)
    assert not list(tmp_path.rglob("*.npy"))


def test_a_disk_without_room_for_the_last_byte_is_a_full_one(fake: Dataset, tmp_path: Path) -> None:
    Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path / "roomy")
    [path] = tmp_path.rglob("values.npy")
    size = path.stat().st_size
    with small_files(size - 1), pytest.raises(DiskError, match=f"{STATE} cannot be written: a file would be"):
        Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path / "tight")
    assert not list((tmp_path / "tight").rglob("*.npy"))
    with small_files(size):
        Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path / "tight")
    [again] = (tmp_path / "tight").rglob("values.npy")
    assert again.read_bytes() == path.read_bytes()


def test_a_failure_leaves_no_raw_file(
    fake: Dataset, frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array_header_1_0", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)
    assert not list(tmp_path.rglob("*.npy"))
    again = Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)
    assert torch.equal(again.columns[STATE], frames.columns[STATE])
