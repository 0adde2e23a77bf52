"""Choose among the policies of a run without the target: the stage `select` on a run that is there."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from astra_data.core.config import only_given, validated
from astra_data.core.errors import BadInputError
from astra_data.core.lock import alone_in
from astra_data.core.manifest import read_manifest
from astra_data.core.progress import Progress, silent
from astra_data.pipeline.own_methods import add_all
from astra_data.pipeline.run import set_aside
from astra_data.pipeline.stages.select import SelectConfig, benches, digests, judge_in
from astra_data.pipeline.stages.select import select as judge_all
from astra_data.pipeline.trained_policy import settings_of
from astra_data.reports.choice import FOLDER, Judged, read_judged
from astra_data.reports.runs import Reported
from astra_data.reports.trials import TRIALS

_log = logging.getLogger(__name__)


def select(
    run: str | Path,
    *,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int | None = None,
    progress: Progress = silent,
) -> Judged:
    """Judge every trained policy of a run, as the stage `select` does; write `select` in the run's folder.

    A choice that is there is kept if it was made of the same with the same settings, and otherwise set aside.

    Args:
        run: the folder of a run whose recipe has two seeds or more.
        rows: candidates; by default all rows of the recipe that have policies of abstract states.
        judge: the row whose groundings judge; by default as the recipe says, or its reference.
        episodes: of each policy with each judge; by default as the recipe says, or 100.
        progress: called with the share done and a note.

    Raises:
        BadInputError: it is no run, a row is unknown or has no policy, there are no two groundings, or
            another process runs there.
    """
    folder, settings = Path(run), settings_of(run)
    add_all(settings.get("own_methods", {}))
    asked: dict[str, Any] = settings.get("select") or {}
    config = validated(asked | only_given(judge=judge, episodes=episodes), SelectConfig, f"{folder}: select")
    recipe = Reported(
        name=folder.name,
        task=settings["task"],
        methods=tuple(rows) or tuple(settings["methods"]),
        seeds=tuple(settings["seeds"]),
        settings=settings,
        percents=tuple(settings.get("sweep", {}).get("percent", ())),
    )
    with alone_in(folder):
        kept = read_judged(folder) if _is_current(folder, recipe, config) else None
        if kept is None:
            judge_all(recipe, config, root=folder, progress=progress)
            kept = read_judged(folder)
    assert kept is not None
    return kept


def _is_current(folder: Path, recipe: Reported, config: SelectConfig) -> bool:
    """Return whether the choice in `folder` is this one; set aside another one."""
    out = folder / FOLDER
    if out.is_symlink():
        raise BadInputError(
            f"{out} belongs to {out.resolve().parent}, which this run is based on: run select there"
        )
    if not out.is_dir():
        return False
    judge = judge_in(recipe, config)
    read = digests([bench.finished(folder) for bench in benches(recipe, judge)], folder)
    manifest, settings = read_manifest(out), out / "config.json"
    same = manifest is not None and manifest.made_from == read and not manifest.faults(out, verify=False)
    if same and settings.read_text() == config.model_dump_json(indent=1):
        return True
    aside = set_aside(folder, FOLDER)
    if (aside / TRIALS).is_file():
        _log.warning("choosing again; the old choice, with its trials in the target, is in %s", aside)
    return False
