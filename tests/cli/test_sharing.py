from pathlib import Path

import pytest
from command_line import output_of
from fake_dataset import write_fake
from shared_files import contents

from astra_data.core.errors import BadInputError, SharingError
from astra_data.dataset.edit import subset
from astra_data.dataset.reader import Dataset


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("astra_data.io.hub.card.png", lambda figure: b"\x89PNG")
    monkeypatch.chdir(tmp_path)
    return write_fake(tmp_path / "fake")


def test_a_version_goes_to_a_folder_and_back(fake: Dataset, tmp_path: Path) -> None:
    place = f"file://{tmp_path}/shared"
    assert output_of("push", str(fake.root), "./shared") == f"shared: {place}/fake@data-1.0.0\n"
    home = tmp_path / "home/fake/data-1.0.0"
    assert output_of("pull", f"{place}/fake", "--version", "1.0.0") == f"fake@data-1.0.0: {home}\n"
    assert contents(home) == contents(fake.root)
    out = tmp_path / "out"
    assert output_of("pull", f"{place}/fake", "--out", str(out)) == f"fake@data-1.0.0: {out}\n"
    with pytest.raises(BadInputError, match=r"no version data-2\.0\.0"):
        output_of("pull", f"{place}/fake", "--version", "2.0.0")
    with pytest.raises(SharingError, match=r"bytes, of which at most 10 are taken"):
        output_of("pull", f"{place}/fake", "--out", str(tmp_path / "large"), "--max-bytes", "10")


def test_a_version_that_is_a_subset_of_another_is_told(fake: Dataset, tmp_path: Path) -> None:
    subset(fake, percent=40, out=tmp_path / "part")
    place, note = f"file://{tmp_path}/shared", "note: it was made by subset from fake@data-1.0.0; "
    output_of("push", str(fake.root), "./shared")
    newest = "who pulls without a version gets the newest that is there"
    assert output_of("push", "part", "./shared") == f"shared: {place}/fake@data-1.1.0\n{note}{newest}\n"
    home = tmp_path / "home/fake/data-1.1.0"
    shown = f"fake@data-1.1.0: {home}\n{note}--version takes another\n"
    assert output_of("pull", f"{place}/fake") == shown


def test_a_card_is_written_with_its_notes(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text('license = "mit"\n')
    assert (
        output_of("export", str(fake.root), "--format", "card", "--out", "fake.md")
        == "written: fake.md\nwritten: fake-coverage.png\n"
    )
    assert "license: unknown" in (tmp_path / "fake.md").read_text()
    out = tmp_path / "it.md"
    output_of("export", str(fake.root), "--format", "card", "--out", str(out), "--notes", "notes.toml")
    assert "license: mit" in out.read_text()


def test_private_is_for_the_hub(fake: Dataset) -> None:
    with pytest.raises(BadInputError, match="private is for the Hugging Face Hub"):
        output_of("push", str(fake.root), "./shared", "--private")
