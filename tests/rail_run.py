"""A small run on the rail: seeds and rows that are trained and not tested, in seconds."""

import json
import shutil
from pathlib import Path

import pytest
from quick_runs import fit_quickly, run_here, small_tables
from shared_runs import shared

ROOT = Path(__file__).parents[1]
COLLECT = """
[collect]
episodes = 8
max_steps = 40
start = "task"
hold_s = [0.1, 0.4]
"""
SMALL = COLLECT + small_tables(held_out_share=0.25, episodes=3)


def make(place: Path) -> None:
    """Make the run up to its policies, of rows without a latent and with one."""
    rows = 'methods = ["direct_transfer", "nas", "astra"]\nseeds = [0, 1, 2]\n'
    (place / "rail.toml").write_text(f'task = "{ROOT}/tests/small_cart.py:TASK"\n{rows}{SMALL}')
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        run_here(place / "rail.toml", until="align")


def rail_run(factory: pytest.TempPathFactory, *, seeds: list[int], methods: list[str]) -> Path:
    """Return a copy of the run, of some of its seeds and rows."""
    folder = Path(shutil.copytree(shared(factory, "rail", make) / "runs/rail", factory.mktemp("rail") / "rail"))
    settings = json.loads((folder / "recipe.json").read_text())
    (folder / "recipe.json").write_text(json.dumps(settings | {"seeds": seeds, "methods": methods}))
    for made in [*folder.glob("*/*/seed_*")]:
        is_asked = made.parent.name in methods and int(made.name.removeprefix("seed_")) in seeds
        if not is_asked:
            shutil.rmtree(made)
    return folder
