"""Kill the stages that write datasets at random moments, and check that nothing is broken or lost.

    uv run python tools/kill_stages.py --kills 200

Each stage runs in a forked process that is sent SIGKILL after a random share of the time that it takes. After
every kill the dataset must be absent or verify, no episode that was safe may be gone, and when the stage is
at last left alone, its dataset must be the one of an undisturbed run, value for value.
"""

import json
import os
import signal
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from astra_data.core.progress import silent
from astra_data.dataset import Dataset
from astra_data.exchange.sharing.pull import pull
from astra_data.exchange.sharing.push import push
from astra_data.stages.augment import AugmentConfig, augment
from astra_data.stages.collect import CollectConfig, collect
from astra_data.stages.pair import PairConfig, pair

TASK = "antmaze-umaze"
EPISODES = 100

Work = Callable[[Path], object]
"""Makes the dataset in a folder."""


@dataclass
class Tally:
    """What happened to a stage."""

    kills: int = 0
    kept: int = 0
    """Kills that left finished episodes to go on with."""
    runs: int = 0
    """Datasets that were finished in the end, each equal to the undisturbed one."""


def main(
    kills: Annotated[int, typer.Option(help="Kills, shared out among the stages.")] = 200,
    seed: Annotated[int, typer.Option(help="Of the moments.")] = 0,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print how many kills each stage survived; stop with an error at the first that it did not."""
    torch.set_num_threads(1)
    # The threads that Python warns of are numpy's, and idle.
    warnings.filterwarnings("ignore", message=".*use of fork", category=DeprecationWarning)
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        stages = prepare(Path(folder))
        tallies = {
            name: torment(work, Path(folder) / f"killed_{name}", kills // len(stages), rng)
            for name, work in stages.items()
        }
    table = Table("stage", "kills", "left episodes to go on with", "finished, equal to the undisturbed")
    for name, tally in tallies.items():
        table.add_row(name, str(tally.kills), str(tally.kept), str(tally.runs))
    Console().print(table)
    if json_path is not None:
        report = {name: vars(tally) for name, tally in tallies.items()}
        json_path.write_text(json.dumps(report, indent=2) + "\n")


def prepare(folder: Path) -> dict[str, Work]:
    """Return the stages by name, each as a function of the dataset's folder."""
    behavior = CollectConfig(episodes=EPISODES, num_envs=10, max_steps=60)
    source = folder / "source"
    # In forked processes too: what they start in this one could block those that are forked later.
    attempt(lambda out: collect(TASK, behavior, seed=0, out=out, progress=silent), source, None)
    address = (folder / "shared").as_uri()
    attempt(lambda out: push(out, address), source, None)
    shared = f"{address}/{Dataset.open(source).description['name']}"

    return {
        "collect": lambda out: collect(TASK, behavior, seed=0, out=out, progress=silent),
        "pair": lambda out: pair(TASK, PairConfig(), dataset=source, out=out, progress=silent),
        "augment": lambda out: augment(
            TASK, AugmentConfig(margin_m=0.6), dataset=source, seed=0, out=out, progress=silent
        ),
        "pull": lambda out: pull(shared, out=out),
    }


def torment(work: Work, out: Path, kills: int, rng: np.random.Generator) -> Tally:
    """Run `work` again and again, killing it `kills` times."""
    whole = out.with_name(f"{out.name}_whole")
    began = time.perf_counter()
    attempt(work, whole, None)
    seconds = time.perf_counter() - began
    wanted = Dataset.open(whole).content_hash
    tally = Tally()
    while tally.kills < kills:
        target = out.with_name(f"{out.name}_{tally.runs}")
        safe: set[str] = set()
        while not target.exists() and tally.kills < kills:
            tally.kills += attempt(work, target, float(rng.uniform(0, 1.1 * seconds)))
            staged = {path.stem for path in target.with_name(f".{target.name}.staged").glob("*.arrow")}
            assert target.exists() or staged >= safe, f"{target}: {sorted(safe - staged)} were safe"
            safe = staged
            tally.kept += bool(safe)
        if not target.exists():
            attempt(work, target, None)
        dataset = Dataset.open(target)
        faults = dataset.verify()
        assert not faults, f"{target}: {faults}"
        assert dataset.content_hash == wanted, f"{target} is not what an undisturbed run gives"
        tally.runs += 1
    return tally


def attempt(work: Work, out: Path, seconds: float | None) -> bool:
    """Do `work` in a forked process, and kill it after `seconds`; return whether that came before its end."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            work(out)
            status = 0
        finally:
            os._exit(status)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if not os.WIFSIGNALED(status):
        assert os.WEXITSTATUS(status) == 0, "the stage failed by itself"
    return os.WIFSIGNALED(status)


if __name__ == "__main__":
    typer.run(main)
