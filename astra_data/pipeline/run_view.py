"""A run in Rerun (https://rerun.io): held-out episodes, and their replays in each of its simulators."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from astra_data.core.arrays import as_rows
from astra_data.core.artifact import check_made_from
from astra_data.core.config import validated
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError, optional
from astra_data.core.lazy import torch
from astra_data.core.naming import row_of_key
from astra_data.dataset.columns import ABSTRACT_NEXT_STATE, ABSTRACT_STATE, ACTION, Array, Column
from astra_data.dataset.edit import check_uids
from astra_data.dataset.reader import Dataset
from astra_data.grounding.files import load_grounding
from astra_data.grounding.open_loop import replay_open_loop
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING, Grounding
from astra_data.pipeline.plan import plan, selected
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.registry import STAGES
from astra_data.pipeline.trained_policy import settings_of
from astra_data.robots.registry import task_named


def view_run(run: Path, uids: Sequence[int] = (), *, seed: int | None = None, save: Path | None = None) -> None:
    """Show episodes of a run's pairs, and replays of their commands in the raw and every grounded simulator.

    By default these are the first 5 `uids` that groundings held out, of the first `seed` of the recipe.
    `save` is a file that ends in `.rrd` and is replaced, in place of the viewer.
    """
    rerun = optional("rerun")
    if save is not None and save.suffix != ".rrd":
        raise BadInputError(f"--save {save}: expected a file that ends in .rrd")
    recipe = validated(settings_of(run), Recipe, f"{run}")
    seeds = recipe.seeds[:1] if seed is None else (seed,)
    selection = selected(recipe, seeds=seeds, percents=sorted(recipe.sweep.percent)[-1:])
    items = plan(recipe, Path(f"{run}.toml"), run, selection)
    pairs = next(run / item.key for item in items if item.stage == "pair")
    if not pairs.is_dir():
        raise BadInputError(f"{run} has no pairs of seed {seeds[0]} yet: run the recipe until pair")
    dataset, held_out = Dataset.open(pairs), (episodes := PairedEpisodes.load(pairs, whole=True))
    check_uids(dataset, uids)
    simulators: dict[str, Grounding] = {"raw": NO_GROUNDING}
    for item in items:
        made = run / item.key / str(STAGES["ground"].result)
        if item.stage == "ground" and made.is_file():
            assert isinstance(item.call, partial)
            share, drawn = item.call.keywords["config"].held_out_share, item.call.keywords["seed"]
            if (data := item.call.keywords["dataset"]).is_dir():
                check_made_from(made, {"dataset": Dataset.open(data).content_hash})
            whole = PairedEpisodes.load(data, whole=True) if data.is_dir() and data != pairs else episodes
            held_out = whole.split(share, drawn)[1]
            simulators[row_of_key(item.key)] = load_grounding(made)
    wanted = torch.tensor(uids or held_out.uids[:5].tolist())
    episodes, task = (episodes.select(torch.isin(episodes.uids, wanted).nonzero()[:, 0]), task_named(recipe.task))
    episodes.check(task)
    replays = {name: replay_open_loop(task, one, episodes, seed=0) for name, one in simulators.items()}

    from astra_data.reports.figures.style import method_color

    stream = rerun.RecordingStream("astra-data", recording_id=dataset.reference)
    recorded = stream.binary_stream() if save else None
    try:
        if not save:
            stream.spawn()
            stream.flush()  # without a display the viewer ends only now
    except RuntimeError as error:
        advice = "activate the environment where rerun-sdk is installed, or use --save FILE.rrd"
        reason = str(error).partition("\n")[0]
        raise BadInputError(f"the viewer does not open ({reason}): {advice}") from error

    def send(entity: str, column: Column, given: Array, color: str) -> None:
        values, steps = as_rows(given), np.arange(len(given))
        times = rerun.TimeColumn("step", sequence=steps), rerun.TimeColumn("time", duration=steps / task.fps)
        for label, one in zip(column.labels, values.T.astype(np.float64), strict=True):
            stream.send_columns(f"{entity}/{label}", times, rerun.Scalars.columns(scalars=one))
        if {"x", "y"} <= set(column.labels):
            line = np.pad(values[:, [column.labels.index(one) for one in "xy"]], ((0, 0), (0, 1)))
            stream.log(entity, rerun.LineStrips3D([line], colors=[*bytes.fromhex(color)]), static=True)

    rows = [dataset.uids.tolist().index(uid) for uid in episodes.uids.tolist()]
    for number, episode in enumerate(dataset.episodes([ABSTRACT_STATE, ABSTRACT_NEXT_STATE, ACTION], rows)):
        root, columns = f"episode_{episode.uid}", episode.columns
        path = np.concatenate([columns[ABSTRACT_STATE], columns[ABSTRACT_NEXT_STATE][-1:]])
        send(f"{root}/target", task.abstract_state, path, "1f77b4")
        send(f"{root}/target", task.action, columns[ACTION], "1f77b4")
        for name, replay in replays.items():
            color = "ffbb78" if name == "raw" else method_color(name)[1:]
            path = replay[number, : len(path)].numpy()
            send(f"{root}/open_loop/{name}", task.abstract_state, path, color)
    if save and recorded is not None:
        write_file(save, recorded.read())
    stream.flush()
