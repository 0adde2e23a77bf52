import tarfile
from pathlib import Path

from astra_data.exchange.recording import find_sources
from astra_data.exchange.source_names import identities, named_apart


def test_files_of_one_name_in_several_recordings_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    for name in ("a/run/log.csv", "b/run/log.csv", "b/log.csv", "c/other.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    files = ["a/run/log.csv", "b/run/log.csv", "b/log.csv", "c/other.csv", "c/other.csv"]
    sources = [source for name in files for source in find_sources(tmp_path / name, [])]
    expected = ["a/run/log.csv", "b/run/log.csv", "b/log.csv", "other.csv", "other.csv"]
    assert [str(source) for source in named_apart(sources)] == expected
    assert [one["name"] for one in identities(sources)] == expected[:4]
    folders = [*find_sources(tmp_path / "a", [".csv"]), *find_sources(tmp_path / "b", [".csv"])]
    assert [str(source) for source in named_apart(folders)] == ["a/run/log.csv", "log.csv", "b/run/log.csv"]


def test_members_of_archives_of_one_name_are_told_apart_by_the_folders_of_these(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        with tarfile.open(tmp_path / folder / "logs.tgz", "w:gz") as opened:
            for name in ("1.json", f"{folder}.json"):
                opened.addfile(tarfile.TarInfo(name))
    sources = [s for folder in ("a", "b") for s in find_sources(tmp_path / folder / "logs.tgz", [".json"])]
    names = ["a/logs.tgz/1.json", "logs.tgz/a.json", "b/logs.tgz/1.json", "logs.tgz/b.json"]
    assert [str(source) for source in named_apart(sources)] == names
    assert [one["name"] for one in identities(sources)] == ["a/logs.tgz", "b/logs.tgz"]
