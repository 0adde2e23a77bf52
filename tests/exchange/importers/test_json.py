from pathlib import Path

import pytest
from recordings import imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.exchange.importers import json


def test_json_that_is_too_large_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_table(tmp_path / "log.json", rows())
    monkeypatch.setattr(json, "LIMIT_BYTES", 100)
    with pytest.raises(BadInputError, match="split the file"):
        imported(tmp_path, path)


def test_a_field_that_comes_twice_is_told(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.json", rows())
    path.write_text(path.read_text().rstrip().removesuffix("}") + ', "x": [0]}')
    with pytest.raises(BadInputError, match="an object has x more than once"):
        imported(tmp_path, path)
