from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
import torch
from recordings import MAPPING, rows
from toy_joints import FPS, NAMES, positions, targets

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset

PACE = Path(__file__).parents[3] / "recipes/imports/pace_anymal.toml"


def anymal(path: Path, count: int = 1200) -> dict[str, torch.Tensor]:
    """Write a log of 12 joints; return what it holds."""
    parts = [targets(count, seed) for seed in range(4)]
    log = {
        "time": torch.linspace(0, count / FPS, steps=count),
        "dof_pos": torch.from_numpy(np.concatenate([positions(part)[:-1] for part in parts], axis=1)).float(),
        "des_dof_pos": torch.from_numpy(np.concatenate(parts, axis=1)).float(),
    }
    torch.save(log, path)
    return log


def test_a_log_of_pace_arrives_row_by_row(tmp_path: Path) -> None:
    log = anymal(tmp_path / "chirp_data.pt")
    dataset = Dataset.open(import_dataset([tmp_path / "chirp_data.pt"], PACE, out=tmp_path / "out").root)
    assert (dataset.lengths.tolist(), dataset.info["fps"]) == ([1199], 400)
    got = dataset.columns([STATE, NEXT_STATE, ACTION])
    np.testing.assert_array_equal(got[STATE], log["dof_pos"][:-1])
    np.testing.assert_array_equal(got[NEXT_STATE], log["dof_pos"][1:])
    np.testing.assert_array_equal(got[ACTION], log["des_dof_pos"][:-1])
    names = {column.name: column.names for column in dataset.schema}
    assert names[STATE] == names[ACTION] and (names[STATE] or ())[:3] == NAMES


def test_other_dictionaries_of_tensors_are_mapped(tmp_path: Path) -> None:
    fields = {name: torch.from_numpy(values) for name, values in rows().items()}
    torch.save(fields | {"robot": "walker", "rate": 3}, tmp_path / "log.pth")
    (tmp_path / "mapping.toml").write_text(MAPPING)
    report = import_dataset([tmp_path / "log.pth"], tmp_path / "mapping.toml", out=tmp_path / "out")
    assert report.episodes == 3
    with pytest.raises(BadInputError, match=r"torch has no standard fields; pass --mapping FILE\.toml$"):
        import_dataset([tmp_path / "log.pth"], name="other", out=tmp_path / "other")


class Harmful:
    """Leaves a trace where it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[Path, str]]:
        return Path.write_text, (self.trace, "ran")


def test_nothing_of_a_file_is_run(tmp_path: Path) -> None:
    torch.save({"time": Harmful(tmp_path / "trace")}, tmp_path / "log.pt")
    with pytest.raises(BadInputError, match="holds Python objects, which are never unpickled"):
        import_dataset([tmp_path / "log.pt"], PACE, out=tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.pt"]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (torch.zeros(3), "expected a dictionary of tensors, got Tensor"),
        ({"time": torch.zeros(3), "dof_pos": torch.zeros(3, 2)}, "no field 'des_dof_pos'"),
        (
            {"time": torch.zeros(3), "dof_pos": torch.zeros(3, 2), "des_dof_pos": torch.zeros(4, 2)},
            r"differ in their number of rows \(dof_pos 3, des_dof_pos 4, time 3\)",
        ),
    ],
)
def test_what_does_not_fit_is_told(tmp_path: Path, content: object, told: str) -> None:
    torch.save(content, tmp_path / "log.pt")
    with pytest.raises(BadInputError, match=told):
        import_dataset([tmp_path / "log.pt"], PACE, out=tmp_path / "out")


def test_what_unpacks_to_far_more_than_its_size_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.io.recording.SMALL_BYTES", 10**5)
    log = {name: torch.zeros(10**5, 2) for name in ("time", "dof_pos", "des_dof_pos")}
    torch.save(log, tmp_path / "plain.pt")
    with ZipFile(tmp_path / "plain.pt") as plain, ZipFile(tmp_path / "log.pt", "w", ZIP_DEFLATED) as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    with pytest.raises(BadInputError, match=r"holds values of 24.* --max-bytes"):
        import_dataset([tmp_path / "log.pt"], PACE, out=tmp_path / "out")
    # A tensor may claim more rows than it stores.
    torch.save({name: torch.zeros(1, 2).expand(10**9, 2) for name in log}, tmp_path / "claims.pt")
    with pytest.raises(BadInputError, match="--max-bytes"):
        import_dataset([tmp_path / "claims.pt"], PACE, out=tmp_path / "out")
