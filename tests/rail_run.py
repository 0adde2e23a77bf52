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


def write_recipe(place: Path, *, seeds: str = "[0, 1, 2]", methods: str = "", more: str = "") -> Path:
    """Write the recipe of such a run."""
    path = place / "rail.toml"
    task = f'task = "{ROOT}/tests/small_cart.py:TASK"\n'
    rows = methods or '["direct_transfer", "nas"]'
    path.write_text(f"{task}methods = {rows}\nseeds = {seeds}\n{SMALL}{more}")
    return path


def make_rail_run(place: Path, *, seeds: str = "[0, 1, 2]", methods: str = "", more: str = "") -> Path:
    """Make such a run up to its policies; return its folder."""
    path = write_recipe(place, seeds=seeds, methods=methods, more=more)
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        return run_here(path, until="align")


def rail_run(factory: pytest.TempPathFactory, *, seeds: list[int], methods: list[str]) -> Path:
    """Return a copy of one such run of rows without a latent and with one, of some of its seeds and rows."""
    rows = '["direct_transfer", "nas", "astra"]'
    whole = shared(factory, "rail", lambda place: make_rail_run(place, methods=rows)) / "runs/rail"
    folder = Path(shutil.copytree(whole, factory.mktemp("rail") / "rail"))
    settings = json.loads((folder / "recipe.json").read_text())
    (folder / "recipe.json").write_text(json.dumps(settings | {"seeds": seeds, "methods": methods}))
    for made in [*folder.glob("*/*/seed_*")]:
        is_asked = made.parent.name in methods and int(made.name.removeprefix("seed_")) in seeds
        if not is_asked:
            shutil.rmtree(made)
    return folder
