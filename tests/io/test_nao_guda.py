"""The mapping of the NAO's logs."""

import io
import json
import tarfile
from pathlib import Path

import numpy as np

from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset

ROOT = Path(__file__).parents[2]
MAPPING = ROOT / "recipes/imports/nao_guda.toml"


def test_the_mapping_fits_logs_of_the_same_form(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.uniform(-3, 3, (2000, 5)), axis=0)
    position[1500:, :2] += 2000
    actions = rng.normal(0, 2, (2000, 4))
    with tarfile.open(tmp_path / "traj.tar.gz", "w:gz") as archive:
        for number, part in ((2, slice(1000, 2000)), (0, slice(0, 0)), (1, slice(0, 1000))):
            log = {"observations": position[part].tolist(), "actions": actions[part].tolist()}
            content = json.dumps(log).encode()
            info = tarfile.TarInfo(f"guda/trajectories_5_{number}.log")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    report = import_dataset([tmp_path / "traj.tar.gz"], MAPPING, out=tmp_path / "out")
    dataset = Dataset.open(report.root)
    assert dataset.lengths.tolist() == [1499, 499] and report.tally.split_points == {"jump": 1}
    kept = np.delete(np.arange(2000), [1499, 1999])
    expected = (position * [0.001, 0.001, 1, 0.001, 0.001]).astype(np.float32)
    got = dataset.columns([STATE, NEXT_STATE, ACTION])
    np.testing.assert_array_equal(got[STATE], expected[kept])
    np.testing.assert_array_equal(got[NEXT_STATE], expected[kept + 1])
    np.testing.assert_array_equal(got[ACTION], actions[kept].clip(-1, 1).astype(np.float32))
    assert dataset.features[STATE]["astra"]["unit"] == ["m", "m", "rad", "m", "m"]
