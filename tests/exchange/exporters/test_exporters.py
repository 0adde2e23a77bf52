"""What all exporters have in common."""

import sys
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import write_fake
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import ACTION, REWARD, TERMINATED, TRUNCATED
from astra_data.exchange.exporters import EXPORTERS, export
from astra_data.exchange.importing import import_dataset


@pytest.mark.parametrize("format", ["d4rl", "robomimic"])
def test_the_way_there_and_back_keeps_how_episodes_end(dataset: Dataset, tmp_path: Path, format: str) -> None:
    export(dataset, tmp_path / "set.hdf5", format=format)
    report = import_dataset([tmp_path / "set.hdf5"], out=tmp_path / "back", name="back", fps=10)
    names = [ACTION, REWARD, TERMINATED, TRUNCATED]
    back, expected = Dataset.open(report.root), dataset.columns(names)
    assert back.lengths.tolist() == dataset.lengths.tolist()
    assert expected[TERMINATED].any()
    assert expected[TRUNCATED].any()
    for name, values in back.columns(names).items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_nothing_is_overwritten_and_nothing_half_is_left(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    out = tmp_path / "random-v0"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "episodes", lambda *_: iter([1]))
        with pytest.raises((AttributeError, TypeError)):
            export(dataset, out, format=format)
    assert list(tmp_path.iterdir()) == []
    out.write_text("mine")
    with pytest.raises(BadInputError, match="exists already"):
        export(dataset, out, format=format)
    assert out.read_text() == "mine"


def test_what_is_missing_is_told(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInputError, match=r"format 'd4lr': unknown: did you mean 'd4rl'\?"):
        export(dataset, tmp_path / "a", format="d4lr")
    with pytest.raises(BadInputError, match=r"it lacks next\.observation\.state"):
        export(write_fake(tmp_path / "bare"), tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "h5py", None)
    told = (
        r'h5py is needed and not installed: uv sync --extra hdf5 in .*, else pip install "astra-data\[hdf5\]"'
    )
    with pytest.raises(BadInputError, match=told):
        export(dataset, tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(BadInputError, match=r'pip install "astra-data\[minari\]"'):
        export(dataset, tmp_path / "a", format="minari")


def test_the_command_exports(dataset: Dataset, tmp_path: Path) -> None:
    arguments = ["export", str(dataset.root), "--format", "d4rl", "--out", str(tmp_path / "set.hdf5")]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.output == f"finished: {tmp_path / 'set.hdf5'}\n"
