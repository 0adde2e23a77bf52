from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.dataset.versions import Version
from astra_data.io.hub.address import Hub, Url, is_address, parse_place, parse_source


@pytest.mark.parametrize(
    ("text", "place", "version"),
    [
        ("me/it", Hub("me/it"), None),
        ("hf://datasets/me/it", Hub("me/it"), None),
        ("me/it@data-1.2.0", Hub("me/it"), "1.2.0"),
        ("hf://datasets/me/it@1.2.0", Hub("me/it"), "1.2.0"),
        ("s3://bucket/ant", Url("s3://bucket/ant"), None),
        ("s3://bucket/ant/", Url("s3://bucket/ant"), None),
        ("s3://bucket/ant/data-1.2.0", Url("s3://bucket/ant"), "1.2.0"),
        ("file:///tmp/ant@data-10.2.0", Url("file:///tmp/ant"), "10.2.0"),
    ],
)
def test_places_and_versions(text: str, place: Hub | Url, version: str | None) -> None:
    assert parse_source(text) == (place, Version.parse(version) if version else None)


@pytest.mark.parametrize("text", ["ant", "a/b/c", "hf://models/me/it", "hf://me/it", "", "s3://"])
def test_anything_else_is_told(text: str) -> None:
    with pytest.raises(BadInputError, match="expected user/name or hf://datasets/user/name"):
        parse_place(text)


def test_a_folder_is_a_place_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert parse_place("./shared") == parse_place(f"{tmp_path}/shared") == Url(f"file://{tmp_path}/shared")
    assert parse_place("./My Läufe") == Url(f"file://{tmp_path}/My Läufe")
    assert parse_place("~/shared") == Url(f"file://{Path.home()}/shared")
    assert parse_source(f"{tmp_path}/it@data-1.2.0") == (Url(f"file://{tmp_path}/it"), Version(1, 2, 0))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ("me/it", True),
        ("me/it@data-1.2.0", True),
        ("s3://bucket/a/b/ant", True),
        ("ant", False),
        ("ant@data-1.2.0", False),
        ("runs/cart/pair", False),
        ("./it", False),
        ("../me/it", False),
        ("/it", False),
    ],
)
def test_an_address_is_told_from_a_folder_and_a_name(data: str, expected: bool) -> None:
    assert is_address(data) is expected


def test_a_folder_that_is_there_is_no_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("me/it").mkdir(parents=True)
    assert not is_address("me/it") and is_address("you/it")
