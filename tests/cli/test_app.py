import errno
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from failing_disk import small_files
from fake_dataset import write_fake
from typer.main import get_command
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.pipeline.shipped import RECIPES


def test_help_loads_none_of_the_large_packages() -> None:
    """They take seconds, and what `--help` and completion say needs none of them."""
    asked = "import sys; from astra_data.cli import app as cli; sys.argv = ['astra-data', '--help']; cli.main()"
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
    assert done.returncode == 1 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


MISTAKES = {
    "run nope.toml": "nope.toml does not exist",
    "run quickstart": "quickstart does not exist: did you mean recipes/quickstart.toml?",
    "run broken.toml": "broken.toml, line 1",
    "run fake": "fake is a dataset: expected the recipe that made it",
    "run small.toml --until grund": "unknown stage 'grund': did you mean 'ground'?",
    "run small.toml --device gpu": "expected a device such as cpu, cuda or cuda:1, got",
    "run small.toml --jobs 0": "Invalid value for '--jobs'",
    "run small.toml --seed 7": "the recipe has no seed 7; its seeds: 0",
    "run small.toml --percent 7": "the recipe has no size 7; its sizes: none",
    "run small.toml --method nsa": "the recipe has no method 'nsa': did you mean 'nas'?",
    "run small.toml --engine rai": "unknown engine 'rai': did you mean 'ray'?",
    "run wrong.toml": "task: unknown task 'antmaze-umase': did you mean 'antmaze-umaze'?",
    "align wrong.toml": "methods: unknown method 'nsa': did you mean 'nas'?",
    "check wrong.toml": "trian: unknown key: did you mean 'train'?",
    "train wrong.toml": "ground.updats: unknown key: did you mean 'updates'?",
    "report wrong.toml": "evaluate.episodes: expected a whole number, got 'many'",
    "ground wrong.toml": "collect.episodes: expected greater than or equal to 1, got 0",
    "run based.toml": "based_on: unknown recipe 'smal': did you mean 'small'?",
    "run data.toml": "data: no dataset 'nowhere' in",
    "check a.toml b.toml": "a.toml does not exist",
    "check antmaze-umase": "unknown task 'antmaze-umase': did you mean 'antmaze-umaze'?",
    "check no.py:TASK": "no.py does not exist in",
    "evaluate small.toml --out x": "--out goes with --policy",
    "evaluate small.toml --policy no.py:P --method nas --seed 0 --out x": "no.py does not exist",
    "select none": "none: expected the folder of a run (with recipe.json)",
    "select runs/cart --field 3": "--by-hand, --field and --percent need --trials",
    "select runs/cart --row nsa": "unknown method 'nsa': did you mean 'nas'?",
    "deploy none --row astra": "none: expected the folder of a run (with recipe.json)",
    "deploy runs/car --row nas": "with astra-data run: did you mean 'runs/cart'?",
    "deploy runs/cart --row nsa": "the run has no row 'nsa': did you mean 'nas'?",
    "deploy runs/cart --row nas": "expected runs/cart/train/nas/seed_0/policy.safetensors",
    "deploy runs/cart --row nas --out fake": "fake exists already",
    "view none": "none: expected the folder of a run (with recipe.json)",
    "view runs/cart --seed 9": "the recipe has no seed 9; its seeds: 0",
    "new robot --from nowhere.csv": "nowhere.csv: no such file, folder or dataset",
    "new fake --from broken.toml": "fake exists already",
    "recipes copy quikstart": "did you mean 'quickstart'?",
    "collect antmaze-umase": "unknown task 'antmaze-umase'",
    "collect no.py:TASK": "no.py does not exist in",
    "collect antmaze-umaze --episodes 0": "collect: episodes: expected greater than or equal to 1, got 0",
    "collect antmaze-umaze --behavior walk": "collect: behavior: expected 'random', 'stress'",
    "collect antmaze-umaze --out fake": "fake exists already",
    "pair none.toml": "none.toml does not exist",
    "pair none --simulator antmaze-umaze": "no dataset 'none' in",
    "pair fake --simulator antmaze-umase": "unknown task 'antmaze-umase'",
    "pair fake --simulator no.py:SIMULATOR": "no.py does not exist in",
    "subset fake --percent 50 --out runs": "runs exists already",
    "label none --task antmaze-umaze": "no dataset 'none' in",
    "label fake --task antmaze-umase": "unknown task 'antmaze-umase'",
    "label fake --task no.py:TASK": "no.py does not exist in",
    "augment none": "no dataset 'none' in",
    "augment fake --rotations quater": "rotations: expected 'quarter', 'any' or 'none', got 'quater'",
    "merge none fake": "no dataset 'none' in",
    "filter fake": "a filter needs a condition",
    "trim fake --without v<": "expected a condition such as",
    "resample none --fps 10": "no dataset 'none' in",
    "features fake --camera front": "has no camera 'observation.images.front'",
    "inspect runs": "runs: found no dataset",
    "validate runs": "runs: found no dataset",
    "repair runs --out x": "meta/info.json is missing",
    "log fake none": "no dataset 'none' in",
    "import nowhere.csv": "nowhere.csv",
    "export fake --format d5rl --out x.hdf5": "d5rl",
    "push none ./shared": "no dataset 'none' in",
    "push fake ./shared --notes none.toml": "none.toml does not exist",
    "pull ./nowhere": "nowhere",
}
CHECKED = ("quickstart", "cart_sizes", "antmaze_umaze", "ablation", "nao_kick", "humanoid_extended", "fetch_reach")


def test_mistakes_and_packaged_recipes_load_nothing_that_takes_seconds(place: Path) -> None:
    recipes = [f"check {RECIPES / name}.toml" for name in CHECKED]
    command = [sys.executable, str(Path(__file__).parents[1] / "commands.py")]
    commands = {one: ["astra-data", *shlex.split(one)] for one in (*MISTAKES, *recipes)}
    asked = json.dumps({"modules": ["astra_data.pipeline.run"], "commands": commands})
    done = subprocess.run(command, input=asked, cwd=place, check=True, capture_output=True, text=True)
    answered = json.loads(done.stdout)
    for mistake, told in MISTAKES.items():
        code, output, loaded = answered[mistake]
        assert code in (1, 2) and told in re.sub(r"\s+", " ", output), f"{mistake}: {output}"
        assert loaded == [], mistake
    for recipe in recipes:
        code, output, loaded = answered[recipe]
        assert code == 0 and "items are finished" in output, output
        # The robots of this one come with gymnasium-robotics.
        assert loaded == (["mujoco", "gymnasium"] if "fetch" in recipe else []), recipe
    assert not (place / "runs/small").exists() and not (place / "x").exists()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recipe, a broken one, the package's quickstart, a run and a dataset."""
    folder = tmp_path_factory.mktemp("place")
    write_fake(folder / "fake")
    (folder / "recipes").mkdir()
    (folder / "recipes/quickstart.toml").touch()
    (folder / "small.toml").write_text('task = "antmaze-umaze"\nmethods = ["nas", "astra"]\nseeds = [0]\n')
    (folder / "broken.toml").write_text("=")
    (folder / "wrong.toml").write_text(
        'task = "antmaze-umase"\nmethods = ["nsa"]\nseeds = [0]\n[ground]\nupdats = 1\n[trian]\n'
        '[collect]\nepisodes = 0\n[evaluate]\nepisodes = "many"\n'
    )
    for key in ('based_on = "smal"', 'data = "nowhere"'):
        text = (folder / "small.toml").read_text()
        (folder / f"{key.partition('_on')[0].partition(' ')[0]}.toml").write_text(text + key)
    (folder / "runs/cart").mkdir(parents=True)
    (folder / "runs/cart/recipe.json").write_text('{"task": "antmaze-umaze", "methods": ["nas"], "seeds": [0]}')
    return folder


def test_every_command_has_an_example_of_options_that_it_has() -> None:
    commands: Any = get_command(cli.app).commands  # type: ignore[attr-defined]
    for example in (example for panel in cli.PANELS.values() for example in panel):
        name, *words = shlex.split(example)
        options = {option for one in commands[name].params for option in one.opts}
        assert {word for word in words if word.startswith("--")} <= options
    shown = CliRunner().invoke(cli.app, ["run", "-h"], env={"COLUMNS": "100"}).output
    assert "Example: astra-data run recipes/quickstart.toml" in shown and "ground, train, align" in shown


def test_the_shell_completes_stages() -> None:
    run: Any = get_command(cli.app).commands["run"]  # type: ignore[attr-defined]
    (until,) = (option for option in run.params if option.name == "until")
    assert [found.value for found in until.shell_complete(run.make_context("run", ["a.toml"]), "gr")] == ["ground"]
    assert "--install-completion" in CliRunner().invoke(cli.app, ["--help"]).output


def test_help_names_what_options_take() -> None:
    commands: Any = get_command(cli.app).commands  # type: ignore[attr-defined]
    for name in commands.keys() - {"recipes"}:
        shown = CliRunner().invoke(cli.app, [name, "--help"], env={"COLUMNS": "160"}).output
        assert not re.search(r"list\[|<(int|str|float|path)", shown), shown


def test_a_folder_that_is_gone_and_names_that_cannot_be_written_are_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    monkeypatch.setattr(sys, "argv", ["astra-data", "log", "walks"])
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    assert capsys.readouterr().err.endswith("this shell is in was removed or replaced: cd to it again\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["astra-data", "log", "w\udcff"])
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    assert capsys.readouterr().err == "error: w\ufffd: expected names in UTF-8: choose others\n"


def test_debugging_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert shown.startswith("error: a file cannot be read or written: the disk is full.") and shown.count("\n") == 1


@pytest.mark.usefixtures("fsync")
def test_waiting_for_the_disk_can_be_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    source = str(write_fake(tmp_path / "fake").root)
    assert synced
    for options, is_synced in (([], True), (["--no-fsync"], False)):
        synced.clear()
        arguments = ["subset", source, "--percent", "100", "--out", str(tmp_path / f"set_{is_synced}")]
        assert CliRunner().invoke(cli.app, [*options, *arguments]).exit_code == 0 and bool(synced) == is_synced
