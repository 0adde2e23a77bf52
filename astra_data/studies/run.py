"""The gap between models of a robot's walk and its recordings: recipe and logs → results and page."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from astra_data.core.config import load_recipe
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import RUNS
from astra_data.pipeline.display import shown
from astra_data.pipeline.recipe import is_gap_recipe, tables_of
from astra_data.studies.gap_recipe import GapRecipe
from astra_data.studies.recordings import place_name, read_recordings
from astra_data.studies.study import run_study


def load_gap_recipe(recipe_path: Path) -> GapRecipe:
    """Read a `GapRecipe` and check that its mapping exists.

    Raises:
        RecipeError: the recipe has faults, or the mapping is missing.
    """
    if {"methods", "based_on"} & tables_of(recipe_path).keys() and not is_gap_recipe(recipe_path):
        raise RecipeError(
            f"{recipe_path}: expected a recipe for `astra-data gap`, got one for `astra-data run`, whose "
            f"gaps `astra-data run {recipe_path} --until ground` writes to gap.md"
        )
    recipe = load_recipe(recipe_path, GapRecipe)
    mapping = recipe_path.parent / recipe.mapping
    if not mapping.is_file():
        raise RecipeError(f"{recipe_path}: mapping: expected a file of `astra-data import`, got {mapping}")
    return recipe


def measure_gap(
    recipe_path: Path,
    data: Path,
    train: Path | None = None,
    *,
    seeds: Sequence[int] = (),
    publish: bool = False,
    root: Path = RUNS,
) -> Path:
    """Fit models to recordings, test them on others, and write page, figure and numbers.

    Args:
        recipe_path: a `GapRecipe`.
        data: recordings to predict.
        train: recordings to learn from; by default a part of `data`.
        seeds: a subset of the recipe's seeds, by default all.
        publish: also copy the results to results/ beside the recipe.
        root: folder of runs.

    Returns:
        The path of the page.

    Raises:
        RecipeError: the recipe has faults.
        BadInputError: there are no usable recordings, or the folder holds results of other settings.
    """
    from astra_data.reports.figures.style import png
    from astra_data.studies.page import figure, render

    recipe = load_gap_recipe(recipe_path)
    unknown = sorted(set(seeds) - set(recipe.seeds))
    if unknown:
        listed, known = (", ".join(map(str, seeds)) for seeds in (unknown, recipe.seeds))
        raise BadInputError(f"the recipe has no seed {listed}; its seeds: {known}")
    if seeds:
        recipe = recipe.model_copy(update={"seeds": tuple(dict.fromkeys(seeds))})
    name = recipe_path.stem
    home, mapping = root / name, recipe_path.parent / recipe.mapping
    imported = home / "recordings"
    tested = read_recordings(data, mapping, imported, recipe.reading)
    learned = [] if train is None else read_recordings(train, mapping, imported, recipe.reading)
    both = {recording.content_hash for recording in tested} & {
        recording.content_hash for recording in learned
    }
    if both:
        raise BadInputError(
            f"{data} and {train} hold the same recordings: expected others to predict than to learn from"
        )
    label = "_from_".join(place_name(place) for place in (data, train) if place is not None)
    folder = home / label
    with _one_thread(), shown(f"{name}/{folder.name}") as progress:
        found = run_study(recipe, tested, learned, folder, progress)
    command = f"uv run astra-data gap {recipe_path} --data {data.name}"
    command += f" --train {train.name}" if train else ""
    command += "".join(f" --seed {seed}" for seed in seeds)
    image = png(figure(found))
    for place, stem in [(folder, "results")] + ([(recipe_path.parent / "results", name)] if publish else []):
        write_file(place / f"{stem}.json", json.dumps(found, indent=1) + "\n")
        write_file(place / f"{stem}.png", image)
        write_file(place / f"{stem}.md", render(found, name, command, f"{stem}.png"))
    return folder / "results.md"


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch use one thread, which is fastest for networks as small as these."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
