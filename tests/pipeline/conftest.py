"""Two small runs, of the ant and of a cart's logs, each made once by all processes of the tests."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from quick_runs import fit_quickly, run_here, small_tables
from shared_runs import shared
from small_run import TASK, short_task, small_run

from astra_data.core.artifact import write_manifest
from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.io.importing import import_dataset
from astra_data.worlds.user_code import user_object


@pytest.fixture
def task() -> Iterator[str]:
    with short_task():
        yield TASK


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the run."""
    return small_run(tmp_path_factory)


def _made(key: str) -> Any:
    """Return a fixture of the folder that is at `key` in the run."""
    return pytest.fixture(scope="session")(lambda small: small / key)


collected, paired = _made("collect/seed_0"), _made("pair/seed_0")
grounded, trained, aligned = (_made(f"{stage}/astra/seed_0") for stage in ("ground", "train", "align"))


@pytest.fixture(scope="session")
def grounded_anew(grounded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grounding with the same settings and other weights."""
    out = Path(shutil.copytree(grounded, tmp_path_factory.mktemp("anew") / "grounding"))
    tensors, told = load_tensors(out / "grounding.safetensors")
    save_tensors(out / "grounding.safetensors", {name: value * 0.5 for name, value in tensors.items()}, told)
    write_manifest(out, {})
    return out


def make_cart(folder: Path) -> None:
    """Make a run of imported logs of the cart, up to its policies; its task has no target."""
    example = Path(__file__).parents[2] / "recipes/examples/cart"
    user_object(f"{example}/robot.py:record")(folder / "csv", drives=8, seconds=6)
    (folder / "cart.py").write_text((example / "cart.py").read_text().replace("horizon=150", "horizon=60"))
    import_dataset(sorted((folder / "csv").glob("*.csv")), example / "logs.toml", out=folder / "logs")
    rows = 'task = "cart.py:TASK"\ndata = "logs"\nmethods = ["direct_transfer", "nas", "astra"]\nseeds = [0]\n'
    tables = small_tables(held_out_share=0.25, episodes=3, train="data_start_share = 0.0")
    (folder / "cart.toml").write_text(rows + tables)
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        run_here(folder / "cart.toml", until="align")


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the module's own with the cart's code, logs, recipe and run."""
    whole = shared(tmp_path_factory, "cart", make_cart)
    return Path(shutil.copytree(whole, tmp_path_factory.mktemp("cart") / "cart"))
