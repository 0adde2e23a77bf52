"""The commands that are tried, each on data so small that it does tens to hundreds of operations on files."""

import json
import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from mcap.writer import Writer

from astra_data.dataset import columns as keys
from astra_data.dataset.writer import DatasetWriter
from disks import looks

COLLECT = "collect antmaze-umaze --episodes 3 --max-steps 6"

RECIPE = """
task = "antmaze-umaze"
methods = ["astra"]
seeds = [0]

[collect]
episodes = 4
max_steps = 24

[ground]
updates = 2
batch_windows = 2
window = 20
latent_size = 4
held_out_share = 0.25

[train]
num_envs = 2
rollout_steps = 4
total_steps = 16
hidden_sizes = [4]
memory_size = 4

[align]
updates = 2
batch_windows = 2
window = 20
held_out_share = 0.25

[evaluate]
episodes = 2
"""
MAPPING = """
name = "log"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["x", "y"]
[columns.action]
fields = ["command"]
[split]
field = "trial"
"""
MCAP_MAPPING = """
name = "log"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["/pose:x", "/pose:y"]
[columns.action]
fields = ["/pose:command"]
[split]
gap_s = 0.35
"""
STAGES = ("collect", "pair", "ground", "train", "align", "evaluate", "report")


@dataclass(frozen=True)
class Command:
    """A command line and what it makes.

    Attributes:
        line: its arguments; "GIVEN" stands for the folder of the inputs, and it runs in a folder of its own.
        look: describes what it made.
        target: what it makes, in the folder that it runs in.
        prepare: fills that folder before it runs, from the folder of the inputs.
        is_light: whether it does without torch.
        adds: whether it adds to what is at the target already, so that running it twice is no mistake.
    """

    line: str
    look: looks.Look = looks.dataset
    target: str = "out"
    prepare: Callable[[Path, Path], object] | None = None
    is_light: bool = True
    adds: bool = False


def _before(stage: str) -> Callable[[Path, Path], None]:
    """Return what copies a run of the recipe in which `stage` and what comes after it is still to be done."""

    def prepare(given: Path, folder: Path) -> None:
        shutil.copytree(given / "runs", folder / "runs")
        for later in STAGES[STAGES.index(stage) :]:
            shutil.rmtree(folder / "runs/tiny" / later)

    return prepare


def _of_recipe(stage: str) -> Command:
    jobs = "" if stage == "report" else "--jobs 1"
    line = f"{stage} GIVEN/tiny.toml --root runs {jobs}"
    return Command(line, looks.files, f"runs/tiny/{stage}", _before(stage), is_light=False, adds=True)


def _on_collected(line: str, look: looks.Look = looks.dataset, target: str = "out", *, adds: bool = False) -> Command:
    return Command(line, look, target, is_light=False, adds=adds)


COMMANDS = {
    "subset": Command("subset GIVEN/walks --episodes 2 --out out"),
    "merge": Command("merge GIVEN/walks GIVEN/others --new-uids --out out"),
    "delete": Command("filter GIVEN/walks --without 7 --out out"),
    "filter": Command("filter GIVEN/walks --min-length 6 --out out"),
    "repair": Command("repair GIVEN/broken --out out"),
    "repair --like": Command("repair GIVEN/stripped --like GIVEN/walks --out out"),
    "import csv": Command("import GIVEN/log.csv --mapping GIVEN/mapping.toml --out out"),
    "import npz": Command("import GIVEN/log.npz --mapping GIVEN/mapping.toml --out out"),
    "import json": Command("import GIVEN/log.json --mapping GIVEN/mapping.toml --out out"),
    "import mcap": Command("import GIVEN/log.mcap --mapping GIVEN/mcap_mapping.toml --out out"),
    "import hdf5": Command("import GIVEN/log.h5 --mapping GIVEN/mapping.toml --out out"),
    "import d4rl": Command("import GIVEN/walks.hdf5 --name back --fps 20 --out out"),
    "export d4rl": Command("export GIVEN/walks --format d4rl --out out.h5", looks.hdf5, "out.h5"),
    "export robomimic": Command("export GIVEN/walks --format robomimic --out out.h5", looks.hdf5, "out.h5"),
    "export d3rlpy": Command("export GIVEN/walks --format d3rlpy --out out.h5", looks.hdf5, "out.h5"),
    "pull": Command("pull GIVEN/shared/walks --out out", adds=True),
    "import minari": _on_collected("import GIVEN/minari-v0 --name back --out out"),
    "export minari": _on_collected("export GIVEN/walks --format minari --out out-v0", looks.files, "out-v0"),
    "card": _on_collected("export GIVEN/walks --format card --out out.md", looks.card, "out.md", adds=True),
    "push": _on_collected("push GIVEN/walks ./shared", looks.remote, "shared/walks", adds=True),
    "collect": _on_collected(f"{COLLECT} --out out --resume"),
    "pair": _on_collected("pair GIVEN/collected --simulator antmaze-umaze --out out"),
    "augment": _on_collected("augment GIVEN/collected --min-steps 2 --out out"),
    **{f"{stage} of a recipe": _of_recipe(stage) for stage in STAGES},
}


def write_inputs(given: Path) -> None:
    """Write datasets and logs to the folder `given`."""
    given.mkdir()
    _write_walks(given / "walks", "walks", (0, 7, 3))
    _write_walks(given / "others", "others", (7, 5))
    shutil.copytree(given / "walks", given / "broken")
    (given / "broken/meta/stats.json").unlink()
    shutil.copytree(given / "walks", given / "stripped")
    shutil.rmtree(given / "stripped/meta/astra")
    (given / "mapping.toml").write_text(MAPPING)
    (given / "mcap_mapping.toml").write_text(MCAP_MAPPING)
    (given / "tiny.toml").write_text(RECIPE)
    _write_logs(given)


def make_inputs(given: Path, run: Callable[[str], object], names: Collection[str]) -> None:
    """Make of them what the commands with these `names` read; `run` runs a command line."""
    run(f"export {given}/walks --format d4rl --out {given}/walks.hdf5")
    if "import minari" in names:
        run(f"export {given}/walks --format minari --out {given}/minari-v0")
    if "pull" in names:
        run(f"push {given}/walks {given}/shared")
    if {"pair", "augment"} & set(names):
        run(f"{COLLECT} --out {given}/collected")
    if any("recipe" in name for name in names):
        run(f"run {given}/tiny.toml --root {given}/runs --jobs 1")


def _write_walks(root: Path, name: str, uids: Sequence[int]) -> None:
    """Write a dataset with every column that an export needs, an episode of 5 to 7 steps for each uid."""
    columns = [
        keys.Column(keys.STATE, size=3),
        keys.Column(keys.NEXT_STATE, size=3),
        keys.Column(keys.ACTION, size=2),
        keys.Column(keys.GOAL, size=2),
    ]
    description = {"name": name, "stage": "collect", "environment": {"id": "walk"}}
    with DatasetWriter(root, [*columns, *keys.OUTCOME_COLUMNS], fps=20, task="walk", description=description) as writer:
        for number, uid in enumerate(uids):
            length = 5 + number
            rng = np.random.default_rng(uid)
            states = rng.normal(size=(length + 1, 3)).astype(np.float32)
            is_last = np.arange(length) == length - 1
            values = {
                keys.STATE: states[:-1],
                keys.NEXT_STATE: states[1:],
                keys.ACTION: rng.normal(size=(length, 2)).astype(np.float32),
                keys.GOAL: np.ones((length, 2), np.float32),
                keys.REWARD: rng.normal(size=length).astype(np.float32),
                keys.TERMINATED: is_last,
                keys.TRUNCATED: np.zeros(length, bool),
                keys.DONE: is_last,
                keys.SUCCESS: is_last,
            }
            writer.add(keys.Episode(uid, values, {"success": True}))


def _write_logs(given: Path) -> None:
    rng = np.random.default_rng(0)
    log = {name: rng.normal(size=12) for name in ("x", "y", "command")} | {"trial": np.repeat([0, 1, 2], 4)}
    rows = [",".join(log), *(",".join(map(str, row)) for row in zip(*log.values(), strict=True))]
    (given / "log.csv").write_text("\n".join(rows) + "\n")
    (given / "log.json").write_text(json.dumps({name: values.tolist() for name, values in log.items()}))
    with (given / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/pose", "json", schema_id=0)
        for row in range(12):
            time_ns = (row + row // 6 * 10) * 10**8  # two episodes, a second apart
            message = {name: float(values[row]) for name, values in log.items()}
            writer.add_message(channel, time_ns, json.dumps(message).encode(), time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    with (given / "log.npz").open("wb") as file:
        np.savez(file, **log)
    with h5py.File(given / "log.h5", "w") as table:
        for name, values in log.items():
            table[name] = values
