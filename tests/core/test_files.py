"""The files below a folder."""

from pathlib import Path

from astra_data.core.durable import files_below


def _file(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    return path


def test_files_are_found_at_any_depth_and_sorted(tmp_path: Path) -> None:
    """Folders themselves are not among them."""
    deep, first = _file(tmp_path / "b/c/file"), _file(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    assert files_below(tmp_path) == [first, deep]


def test_linked_folders_are_entered_and_linked_files_are_files(tmp_path: Path) -> None:
    """Both keep the path by which they were found."""
    _file(tmp_path / "elsewhere/day/log")
    single = _file(tmp_path / "single")
    here = tmp_path / "here"
    here.mkdir()
    (here / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (here / "file").symlink_to(single)
    assert files_below(here) == [here / "file", here / "linked/day/log"]


def test_a_folder_with_two_names_is_entered_once(tmp_path: Path) -> None:
    """Its own path counts before a link, whichever is first in the alphabet; of two links the first does."""
    own = _file(tmp_path / "here/own/log")
    (tmp_path / "here/again").symlink_to(own.parent, target_is_directory=True)
    assert files_below(tmp_path / "here") == [own]
    _file(tmp_path / "elsewhere/log")
    for name in ("y", "x"):
        (tmp_path / "here" / name).symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    assert files_below(tmp_path / "here") == [own, tmp_path / "here/x/log"]


def test_a_link_back_up_has_an_end(tmp_path: Path) -> None:
    """Neither to the folder itself nor to one around it."""
    log = _file(tmp_path / "here/day/log")
    _file(tmp_path / "beside")
    (tmp_path / "here/day/self").symlink_to(tmp_path / "here", target_is_directory=True)
    (tmp_path / "here/day/up").symlink_to(tmp_path, target_is_directory=True)
    assert files_below(tmp_path / "here") == [log]
