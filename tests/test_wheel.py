"""The wheel, installed where nothing else is, with the lowest versions that it allows."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
UV = os.environ.get("UV") or shutil.which("uv")
MAPPING = """
name = "walks"
task = "walk"
fps = 20
[columns."observation.state"]
fields = ["x", "y"]
[columns.action]
fields = ["vx", "vy"]
"""


def output_of(*words: str | Path, folder: Path) -> str:
    """Run a command without this checkout on any path; return what it prints."""
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(word) for word in words], cwd=folder, env=outside, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the programs of an environment that has the wheel and what it needs, without extras."""
    if UV is None:
        pytest.skip("uv builds and installs the wheel, and is not on the path")
    made = tmp_path_factory.mktemp("wheel")
    output_of(UV, "build", "--wheel", "--python", sys.executable, "--out-dir", made, ROOT, folder=made)
    lowest = ["--resolution", "lowest-direct", "--python", sys.executable]
    output_of(UV, "pip", "compile", *lowest, ROOT / "pyproject.toml", "-o", made / "lowest.txt", folder=made)
    output_of(UV, "venv", "--python", sys.executable, made / "venv", folder=made)
    python = made / "venv" / "bin" / "python"
    wheel = next(made.glob("*.whl"))
    output_of(UV, "pip", "install", "--python", python, "-r", made / "lowest.txt", folder=made)
    output_of(UV, "pip", "install", "--python", python, "--no-deps", wheel, folder=made)
    return python.parent


def test_commands_answer_and_recipes_are_in_it(installed: Path, tmp_path: Path) -> None:
    program = installed / "astra-data"
    assert "collect" in output_of(program, "--help", folder=tmp_path)
    assert "--mapping" in output_of(program, "import", "--help", folder=tmp_path)
    assert "quickstart" in output_of(program, "recipes", "list", folder=tmp_path)
    output_of(program, "recipes", "copy", "quickstart", folder=tmp_path)
    copied = tmp_path / "recipes"
    for name in ("quickstart.toml", "examples/cart/cart.py"):
        assert (copied / name).read_bytes() == (ROOT / "recipes" / name).read_bytes()


def test_logs_become_a_dataset(installed: Path, tmp_path: Path) -> None:
    program = installed / "astra-data"
    rows = "".join(f"{step / 10},1.0,2.0,0.5\n" for step in range(40))
    (tmp_path / "walk.csv").write_text("x,y,vx,vy\n" + rows)
    (tmp_path / "walks.toml").write_text(MAPPING)
    output_of(program, "import", "walk.csv", "--mapping", "walks.toml", folder=tmp_path)
    assert "1 episodes" in output_of(program, "validate", "walks", folder=tmp_path)
    output_of(program, "inspect", "walks", folder=tmp_path)
    read = "from astra_data import Dataset; print(Dataset.open('datasets/walks/data-1.0.0').lengths)"
    assert output_of(installed / "python", "-c", read, folder=tmp_path).strip() == "[39]"
