import multiprocessing
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from racing import ROUNDS, race

from astra_data.core.errors import BadInputError
from astra_data.dataset.atomic import atomic_file, atomic_folder


@pytest.mark.parametrize("writing", [atomic_folder, atomic_file])
def test_a_place_that_cannot_be_written_is_told(
    tmp_path: Path, writing: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(BadInputError, match=r"set cannot be written: .*; choose another place"),
        writing(tmp_path / "file" / "set"),
    ):
        pass


def test_an_error_inside_is_not_swallowed_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "set"):
        raise FileNotFoundError
    assert list(tmp_path.iterdir()) == []


def test_racing_processes_make_each_folder_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    racers = [context.Process(target=race, args=(tmp_path,)) for _ in range(3)]
    for racer in racers:
        racer.start()
    for racer in racers:
        racer.join()
    assert [racer.exitcode for racer in racers] == [0, 0, 0]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(map(str, range(ROUNDS)))
