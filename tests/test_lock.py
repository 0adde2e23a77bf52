from pathlib import Path

from astra_data.lock import held


def test_a_folder_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    with held(tmp_path) as first, held(tmp_path) as second, held(tmp_path / "..") as other:
        assert (first, second, other) == (True, False, True)
    with held(tmp_path) as again:
        assert again
