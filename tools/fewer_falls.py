"""Train on cart data with fewer and fewer falls: when does ASTRA's lead begin? Prints Markdown.

    uv run python tools/fewer_falls.py runs/fewer_falls

Collects 400 drives with the settings of recipes/cart_study.toml, draws 60 of them of which so many end in a
fall, and runs NAS and ASTRA on each such set. Goes on where it was interrupted.
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from door import run_tool

from astra_data.core.config import load_tables
from astra_data.core.seeding import generator
from astra_data.dataset.columns import SUCCESS, TERMINATED
from astra_data.dataset.edit import delete
from astra_data.dataset.reader import Dataset
from astra_data.experiments.run import run
from astra_data.reports.files import read_published
from astra_data.reports.schema import Results

STUDY = Path(__file__).parents[1] / "recipes" / "cart_study.toml"
POOL, DRIVES, POOL_SEED = 400, 60, 100
ROWS = ["nas", "astra"]
FALLS, SEEDS = [3, 6, 12, 25, 50], [1, 2, 3]


def main(
    folder: Path,
    falls: Annotated[list[int] | None, typer.Option(help="How many of the drives end in a fall.")] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Of groundings and trainings.")] = None,
    row: Annotated[list[str] | None, typer.Option(help="Of the study.")] = None,
) -> None:
    """Run the study in `folder`; by default 3, 6, 12, 25 and 50 falls, seeds 1 to 3, NAS and ASTRA."""
    folder.mkdir(parents=True, exist_ok=True)
    pool = collected(folder)
    rows = row or ROWS
    print("| falls of 60 drives | steps | " + " | ".join(rows) + " |\n|---|---|" + "---|" * len(rows))
    for count in falls or FALLS:
        data = with_falls(pool, count, folder / f"drives_{count}")
        recipe = folder / f"falls_{count}.toml"
        recipe.write_text(text_of(f'data = "{data.resolve()}"', seed or SEEDS, rows))
        found = read_published(run(recipe, root=folder, jobs=1) / "report" / "results.json")
        assert isinstance(found, Results)
        cells = [", ".join(f"{success:.2f}" for success in found.methods[name].success) for name in rows]
        print(f"| {count} | {Dataset.open(data).lengths.sum():,} | {' | '.join(cells)} |", flush=True)


def text_of(data: str, seeds: list[int], rows: list[str] = ROWS) -> str:
    """Return the recipe of the study with other data, rows and seeds."""
    text, task = STUDY.read_text(), load_tables(STUDY)["task"]
    before, _, after = text.partition("\n[collect]")
    tables = after.partition("\n\n")[2]
    assert before
    head = f'task = "{STUDY.parent / task}"\nmethods = {json.dumps(rows)}\nseeds = {seeds}\n'
    return f"{head}{data}\n\n{tables}"


def collected(folder: Path) -> Dataset:
    """Return the drives to draw from."""
    settings = load_tables(STUDY)["collect"] | {"episodes": POOL}
    table = "\n".join(f"{name} = {json.dumps(value)}" for name, value in settings.items())
    recipe = folder / "pool.toml"
    recipe.write_text(text_of("", [POOL_SEED]) + f"\n[collect]\n{table}\n")
    run(recipe, root=folder, jobs=1, until="collect")
    return Dataset.open(folder / "pool" / "collect" / f"seed_{POOL_SEED}")


def with_falls(pool: Dataset, count: int, out: Path) -> Path:
    """Write `DRIVES` drives of `pool`, of which `count` end in a fall; return the folder."""
    if out.is_dir():
        return out
    ended = pool.columns([TERMINATED, SUCCESS])
    last = pool.lengths.cumsum() - 1
    fell = ended[TERMINATED][last] & ~ended[SUCCESS][last]
    rng = generator(POOL_SEED, "drives with falls")
    fallen, whole = (rng.permutation(np.flatnonzero(which)) for which in (fell, ~fell))
    if not DRIVES - len(whole) <= count <= min(DRIVES, len(fallen)):
        raise typer.BadParameter(
            f"--falls {count}: {len(fallen)} drives of the pool fell, {len(whole)} did not"
        )
    kept = {*fallen[:count].tolist(), *whole[: DRIVES - count].tolist()}
    return delete(pool, [int(uid) for row, uid in enumerate(pool.uids) if row not in kept], out=out)


if __name__ == "__main__":
    run_tool(main)
