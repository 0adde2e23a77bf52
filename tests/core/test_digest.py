import hashlib
from pathlib import Path

import pytest

from astra_data.core.durable import file_digest


def test_a_file_is_read_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = bytes(range(256)) * 10_000
    path = tmp_path / "file"
    path.write_bytes(content)
    monkeypatch.setattr(Path, "read_bytes", None)
    assert file_digest(path) == hashlib.sha256(content).hexdigest()
