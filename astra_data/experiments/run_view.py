"""A run in Rerun: episodes of its dataset, and what its simulators make of the same commands."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from astra_data.core.config import validated
from astra_data.core.errors import BadInputError
from astra_data.core.naming import row_of_key
from astra_data.dataset.columns import ABSTRACT_SIMULATED_NEXT_STATE
from astra_data.dataset.edit import check_uids
from astra_data.dataset.reader import Dataset
from astra_data.experiments.execution import Item
from astra_data.experiments.plan import plan, stage_of
from astra_data.experiments.points import Selection
from astra_data.experiments.recipe import Recipe
from astra_data.experiments.trained_policy import settings_of
from astra_data.grounding.files import load_grounding
from astra_data.grounding.open_loop_replay import OpenLoopReplay, replay_open_loop
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.reports.figures import method_color
from astra_data.reports.rerun_view import ReplayedEpisode, view
from astra_data.stages.registry import STAGES
from astra_data.worlds.registry import task_named

RAW = "raw"
SHOWN = 5
"""Episodes that are shown where none are asked for."""
_RAW_COLOR = (255, 187, 120)


def view_run(
    run: str | Path, uids: Sequence[int] = (), *, seed: int | None = None, save: Path | None = None
) -> str:
    """Show episodes of a run's dataset as `view` does, with open-loop replays in its simulators.

    Each replay begins with its episode and takes the recorded commands: in the `raw` simulator, and in that
    of every finished grounding, by the name of its method, with the `hazard` of its failure model and the
    `disagreement` of its ensemble. Of a run with several sizes, the largest is shown.

    Args:
        run: the folder of a run, such as "runs/quickstart".
        uids: of the episodes; by default the first 5 that groundings held out, or of all where there are no
            groundings.
        seed: one of the recipe's; by default the first.
        save: the recording, in place of the viewer.

    Returns:
        what the run lacks and is left out, empty if nothing.

    Raises:
        BadInputError: as `view`, or it is not the folder of a run, has no dataset yet, or no such seed.
    """
    recipe = validated(settings_of(run), Recipe, f"{run}")
    percents = (max(recipe.sweep.percent),) if recipe.sweep.percent else ()
    selection = Selection.of(recipe, seeds=recipe.seeds[:1] if seed is None else (seed,), percents=percents)
    made = [item for item in plan(recipe, Path(f"{run}.toml"), Path(run), selection) if _is_made(run, item)]
    datasets = [item for item in made if STAGES[stage_of(item)].makes_dataset]
    if not datasets:
        raise BadInputError(
            f"{run} has no dataset of seed {selection.seeds[0]} yet: run the recipe until pair first"
        )
    dataset = Dataset.open(Path(run) / datasets[-1].key)
    check_uids(dataset, uids)
    if ABSTRACT_SIMULATED_NEXT_STATE not in dataset.features:
        view(dataset, uids or dataset.uids[:SHOWN].tolist(), save=save)
        return "all simulators (the dataset is not paired yet)"
    groundings = {row_of_key(item.key): item for item in made if stage_of(item) == "ground"}
    episodes = _chosen(PairedEpisodes.load(dataset.root), uids, [*groundings.values()])
    of: dict[str, Grounding] = {RAW: NO_GROUNDING}
    of |= {name: load_grounding(_result(run, item)) for name, item in groundings.items()}
    task, drawn = task_named(recipe.task), selection.seeds[0]
    episodes.check(task)
    replays = {name: replay_open_loop(task, one, episodes, seed=drawn) for name, one in of.items()}
    view(dataset, uids or episodes.uids.tolist(), save=save, replays=_by_episode(replays, episodes))
    return _lacking({name: replay for name, replay in replays.items() if name != RAW})


def _is_made(run: str | Path, item: Item) -> bool:
    stage = STAGES[stage_of(item)]
    folder = Path(run) / item.key
    return folder.is_dir() if stage.result is None else (folder / stage.result).is_file()


def _result(run: str | Path, item: Item) -> Path:
    return Path(run) / item.key / str(STAGES["ground"].result)


def _chosen(episodes: PairedEpisodes, uids: Sequence[int], groundings: Sequence[Item]) -> PairedEpisodes:
    """Return the episodes `uids`, else the first that were held out."""
    if uids:
        return episodes.select(torch.isin(episodes.uids, torch.tensor(uids)).nonzero()[:, 0])
    if groundings:
        call = groundings[0].call
        assert isinstance(call, partial)
        episodes = episodes.split(call.keywords["config"].held_out_share, call.keywords["seed"])[1]
    return episodes.select(torch.arange(min(SHOWN, len(episodes))))


def _by_episode(
    replays: Mapping[str, OpenLoopReplay], episodes: PairedEpisodes
) -> dict[int, list[ReplayedEpisode]]:
    """Return the replays of each episode, without what comes after it, by its uid."""
    found: dict[int, list[ReplayedEpisode]] = {}
    for number, (uid, steps) in enumerate(
        zip(episodes.uids.tolist(), episodes.lengths.tolist(), strict=True)
    ):
        for name, replay in replays.items():
            measures = {"hazard": replay.hazard, "disagreement": replay.disagreement}
            known = {key: values for key, values in measures.items() if values is not None}
            replayed = ReplayedEpisode(
                name,
                _RAW_COLOR if name == RAW else _rgb(method_color(name)),
                replay.state[number, : steps + 1].numpy(),
                {key: values[number, :steps].numpy() for key, values in known.items()},
            )
            found.setdefault(uid, []).append(replayed)
    return found


def _rgb(color: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue


def _lacking(replays: Mapping[str, OpenLoopReplay]) -> str:
    """Say what the groundings lack, in one line."""
    if not replays:
        return "grounded simulators (none is finished)"
    lacks = {
        "hazard of {} (no failure model)": [n for n, one in replays.items() if one.hazard is None],
        "disagreement of {} (one model with one head)": [
            name for name, one in replays.items() if one.disagreement is None
        ],
    }
    return ", ".join(text.format(" and ".join(names)) for text, names in lacks.items() if names)
