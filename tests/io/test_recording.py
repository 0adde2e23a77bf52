import io
import os
import tarfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.io.recording import MOST_UNPACKED, SMALL_BYTES, Source, find_sources, identities, is_archive, row_count


def listed(*paths: Path, suffixes: Sequence[str] = (".csv",), max_bytes: int | None = None) -> list[Source]:
    return find_sources(paths, "csv", suffixes, max_bytes=max_bytes)


def archive(path: Path, *members: tarfile.TarInfo, content: bytes = b"{}") -> Path:
    with tarfile.open(path, "w:gz") as opened:
        for member in members:
            if member.isreg():
                member.size = len(content)
            opened.addfile(member, io.BytesIO(content))
    return path


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


HIDDEN = (".log_3.csv", "._log_1.csv", ".ipynb_checkpoints/log_1-checkpoint.csv", "__MACOSX/log_1.csv")


def test_files_come_in_the_order_of_their_numbers_without_those_that_are_hidden(tmp_path: Path) -> None:
    names = ("log_10.csv", "log_2.csv", "log_1.csv", "notes.txt", *HIDDEN)
    for name in names:
        (tmp_path / "logs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "logs" / name).write_text("")
    (tmp_path / "logs/latest.csv").symlink_to("log_10.csv")
    found = listed(tmp_path / "logs", tmp_path / "logs/log_2.csv")  # each once
    assert [str(source) for source in found] == ["log_1.csv", "log_2.csv", "log_10.csv"]
    path = archive(tmp_path / "logs.tar.gz", *(member(f"logs/{name}") for name in names))
    in_archive = listed(path)
    assert [source.member.name for source in in_archive if source.member] == [
        "logs/log_1.csv",
        "logs/log_2.csv",
        "logs/log_10.csv",
    ]


def test_members_are_read_without_unpacking(tmp_path: Path) -> None:
    path = archive(tmp_path / "logs.tgz", member("a/1.json"), member("a/2.json"), content=b'{"x": [1]}')
    before = sorted(tmp_path.rglob("*"))
    for source in listed(path, suffixes=[".json"]):
        with source.open() as stream:
            assert stream.read() == b'{"x": [1]}'
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("hostile", "told"),
    [
        (member("/etc/log.json"), "/etc/log.json lies outside"),
        (member("a/../../log.json"), "a/../../log.json lies outside"),
        (member("log.json", tarfile.SYMTYPE, "/etc/passwd"), "log.json is a link"),
        (member("log.json", tarfile.LNKTYPE, "../secret"), "log.json is a link"),
        (member("log.json", tarfile.CHRTYPE), "log.json is a link, a device"),
        (member("log.json", tarfile.GNUTYPE_SPARSE), "log.json is a link, a device or sparse"),
        (member("log.json", tarfile.FIFOTYPE), "log.json is a link, a device"),
    ],
)
def test_hostile_members_are_refused(tmp_path: Path, hostile: tarfile.TarInfo, told: str) -> None:
    path = archive(tmp_path / "logs.tar.gz", member("fine.json"), hostile)
    with pytest.raises(BadInputError, match=told):
        listed(path, suffixes=[".json"])


def test_a_member_that_claims_to_be_huge_is_refused(tmp_path: Path) -> None:
    info = member("log.json")
    info.size = 2**40
    (tmp_path / "logs.tar").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + b"{}".ljust(512, b"\0"))
    with pytest.raises(BadInputError, match="cannot be read as an archive"):
        listed(tmp_path / "logs.tar", suffixes=[".json"])


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="does not exist"):
        listed(tmp_path / "none")
    with pytest.raises(BadInputError, match=r"files that end with \.csv or \.tsv, found none"):
        listed(tmp_path, suffixes=[".csv", ".tsv"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInputError, match="empty: expected files, found none"):
        listed(tmp_path / "empty", suffixes=[""])


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.csv")
    for path in (tmp_path / "log.csv", Path("/dev/zero")):
        with pytest.raises(BadInputError, match="is a device or a pipe, expected a file or a folder"):
            listed(path)


def test_small_recordings_may_unpack_to_what_is_small_and_others_to_a_multiple(tmp_path: Path) -> None:
    for name, size in (("small.npz", 10), ("large.npz", SMALL_BYTES)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)
    small, large = tmp_path / "small.npz", tmp_path / "large.npz"
    for paths, given, most in (
        ([small], None, SMALL_BYTES),
        ([small, large], None, MOST_UNPACKED * (10 + SMALL_BYTES)),
        ([small, large], 7, 7),
    ):
        found = find_sources(paths, "npz", [".npz"], max_bytes=given)
        assert [source.most_bytes for source in found] == [most] * len(paths)
        found[0].refuse_beyond(most)


def test_capitals_hide_no_log(tmp_path: Path) -> None:
    for name in ("a.csv", "b.CSV", "c.Csv"):
        (tmp_path / name).write_text(name)
    assert [str(source) for source in listed(tmp_path)] == ["a.csv", "b.CSV", "c.Csv"]
    assert is_archive(Path("LOGS.TGZ"))


def test_of_a_member_that_was_appended_again_the_last_is_read(tmp_path: Path) -> None:
    path = tmp_path / "logs.tar"
    with tarfile.open(path, "w") as opened:
        for content in (b"first", b"the last one"):
            (tmp_path / "log.csv").write_bytes(content)
            opened.add(tmp_path / "log.csv", "log.csv")
    (source,) = listed(path)
    with source.open() as stream:
        assert stream.read() == b"the last one"


def test_a_field_that_is_read_already_is_not_proposed() -> None:
    shapes = {"q1_deg": (3,), "q2_rad": (3,), "load": (3,)}
    with pytest.raises(BadInputError, match=r"^a: no field 'q1_dog': did you mean 'q1_deg'\?$"):
        row_count("a", ["q1_dog", "load"], shapes)
    with pytest.raises(BadInputError, match=r"^a: no field 'q2_deg': did you mean 'q2_rad'\?$"):
        row_count("a", ["q1_deg", "q2_deg"], shapes)
    with pytest.raises(BadInputError, match=r"^a: no field 'q3'; known: q1_deg, q2_rad, load$"):
        row_count("a", [*shapes, "q3"], shapes)
    many = {f"run_{number}/load": (3,) for number in range(40)}
    with pytest.raises(BadInputError, match=r"^a: no fields 'q', 'u'; known: run_0/load, .*, run_29/load and 10 more$"):
        row_count("a", ["q", "u"], many)


def test_files_are_named_by_their_paths_in_the_folder_that_holds_all_recordings(tmp_path: Path) -> None:
    for name in ("a/run/log.csv", "b/run/log.csv", "b/log.csv", "c/other.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    files = ["a/run/log.csv", "b/run/log.csv", "b/log.csv", "c/other.csv", "c/other.csv"]
    sources = listed(*(tmp_path / name for name in files))
    assert [str(source) for source in sources] == files[:-1]  # each once
    assert [one["name"] for one in identities(sources)] == files[:4]
    folders = listed(tmp_path / "a", tmp_path / "b")
    assert [str(source) for source in folders] == ["a/run/log.csv", "b/log.csv", "b/run/log.csv"]
