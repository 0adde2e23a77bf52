import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError

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
