from dataclasses import replace
from pathlib import Path

from fake_dataset import fake_episodes, write_fake, writer
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.dataset.edit import delete


def run(*arguments: str) -> list[str]:
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    return result.output.splitlines()


def test_lineage_and_differences_are_shown(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "first")
    made = delete(first, [13], out=tmp_path / "made")
    assert run("log", str(made))[1].startswith("└── fake@data-1.0.0  ")
    told = run("diff", str(first.root), str(made))
    assert told[:3] == [
        "fake@data-1.0.0: 5 episodes, 55 steps",
        "fake@data-1.1.0: 4 episodes, 48 steps",
        "1 episodes only in fake@data-1.0.0: 13",
    ]
    assert "stage: 'collect', then 'delete'" in told
    assert run("diff", str(made), str(first.root))[2] == "1 episodes only in fake@data-1.0.0: 13"


def test_values_are_told_from_metadata(tmp_path: Path) -> None:
    first, second = write_fake(tmp_path / "first"), tmp_path / "second"
    with writer(second) as open_writer:
        for episode in fake_episodes():
            open_writer.add(replace(episode, metadata={**episode.metadata, "source": "log.csv"}))
    told = run("diff", str(first.root), str(second))
    assert told[2:] == [
        "0 episodes differ in values",
        "5 episodes differ in metadata: source (0, 4, 6, 13, 9007199254740993)",
    ]
    other = write_fake(tmp_path / "other")
    assert run("diff", str(first.root), str(other.root))[2:] == []
