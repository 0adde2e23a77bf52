from dataclasses import replace
from pathlib import Path

from command_line import output_of
from fake_dataset import fake_episodes, write_fake, writer

from astra_data.dataset.edit import delete


def test_lineage_and_differences_are_shown(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "first")
    made = delete(first, [13], out=tmp_path / "made")
    assert output_of("log", str(made)).splitlines()[1].startswith("└── fake@data-1.0.0  ")
    told = output_of("log", str(first.root), str(made)).splitlines()
    assert told[:3] == [
        "fake@data-1.0.0: 5 episodes, 55 steps",
        "fake@data-1.1.0: 4 episodes, 48 steps",
        "1 episodes only in fake@data-1.0.0: 13",
    ]
    assert "stage: 'collect', then 'delete'" in told
    back = output_of("log", str(made), str(first.root)).splitlines()
    assert back[2] == "1 episodes only in fake@data-1.0.0: 13"


def test_values_are_told_from_metadata(tmp_path: Path) -> None:
    first, second = write_fake(tmp_path / "first"), tmp_path / "second"
    with writer(second) as open_writer:
        for episode in fake_episodes():
            open_writer.add(replace(episode, metadata={**episode.metadata, "source": "log.csv"}))
    told = output_of("log", str(first.root), str(second)).splitlines()
    assert told[2:] == [
        "0 episodes differ in values",
        "5 episodes differ in metadata: source (0, 4, 6, 13, 9007199254740993)",
    ]
    other = write_fake(tmp_path / "other")
    assert output_of("log", str(first.root), str(other.root)).splitlines()[2:] == []
