from pathlib import Path

from fake_dataset import write_fake
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
