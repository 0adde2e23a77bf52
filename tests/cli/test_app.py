import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from failing_disk import small_files
from fake_dataset import write_fake
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset

HEAVY = {"torch", "numpy", "pydantic", "lerobot", "mujoco", "matplotlib"}


def test_help_loads_nothing_slow() -> None:
    code = "import sys, astra_data.cli.app; print(*sorted(name for name in sys.modules if '.' not in name))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not HEAVY & set(loaded.split())


def test_help_loads_none_of_the_large_packages() -> None:
    """They take seconds, and what `--help` and completion say needs none of them."""
    asked = (
        "import sys; from astra_data.cli import app as cli; sys.argv = ['astra-data', '--help']; cli.main()"
    )
    command = [sys.executable, "-X", "importtime", "-c", asked]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "astra-data" in done.stdout
    loaded = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "typer" in loaded
    large = {"torch", "mujoco", "gymnasium", "lerobot", "datasets", "pyarrow", "matplotlib", "scipy", "numpy"}
    assert not loaded & large


def test_the_package_runs_as_a_module_does(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "astra_data", "inspect", str(tmp_path / "none")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_version() -> None:
    result = CliRunner().invoke(cli.app, ["--version"])
    assert result.exit_code == 0
    assert result.output.startswith("astra-data 0.")


def test_bad_input_is_one_line_and_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["astra-data", "check", str(tmp_path / "none.toml")])
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    assert capsys.readouterr().err == f"error: {tmp_path / 'none.toml'} does not exist\n"


def test_debugging_shows_the_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> None:
        raise BadInputError("expected this")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    assert capsys.readouterr().err == "error: expected this\n"
    monkeypatch.setenv("ASTRA_DATA_DEBUG", "1")
    with pytest.raises(BadInputError):
        cli.main()


def test_a_full_disk_is_one_line_and_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_fake(tmp_path / "fake").root
    subset = ["astra-data", "subset", str(source), "--percent", "100", "--out", str(tmp_path / "half")]
    monkeypatch.setattr(sys, "argv", subset)
    with small_files(2000), pytest.raises(SystemExit, match="1"):
        cli.main()
    assert capsys.readouterr().err == (
        f"error: {tmp_path / 'half'} cannot be written: a file would be larger than is allowed. What was "
        "finished before is safe: raise the limit (ulimit -f), then run the same command again.\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["fake"]
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    assert Dataset.open(tmp_path / "half").verify() == []


def test_no_error_of_a_disk_becomes_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    shown = capsys.readouterr().err
    assert shown.startswith("error: a file cannot be read or written: the disk is full.")
    assert shown.count("\n") == 1


@pytest.mark.usefixtures("fsync")
def test_waiting_for_the_disk_can_be_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    source = str(write_fake(tmp_path / "fake").root)
    assert synced
    for options, is_synced in (([], True), (["--no-fsync"], False)):
        synced.clear()
        arguments = ["subset", source, "--percent", "100", "--out", str(tmp_path / f"set_{is_synced}")]
        assert CliRunner().invoke(cli.app, [*options, *arguments]).exit_code == 0
        assert bool(synced) == is_synced
