"""Ground: fit a correction of the abstract simulator, and report its open-loop error."""

import json
from contextlib import chdir
from pathlib import Path

from pydantic import ValidationError

from astra_data.core.artifact import finished_folder
from astra_data.core.config import Config, as_json, faults_of
from astra_data.core.errors import BadInputError
from astra_data.core.naming import base_method
from astra_data.core.progress import CLOCKS, Progress, Stopwatch, part, silent
from astra_data.core.provenance import origin
from astra_data.grounding.files import GROUNDING, check_step, fitted, load_grounding, save_grounding
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.grounding.open_loop import gap_report
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import is_of_package, method_named
from astra_data.reports.artifacts import GAP, METRICS, Metrics
from astra_data.robots.registry import task_named

_FIT_SHARE = 0.95  # of the progress
_DERIVED = ("updates", "window", "reward_shrinkage", "clearance_m", "failure_model_latent")  # from the data


def ground(
    task: str,
    method: str,
    config: GroundConfig = GroundConfig(),
    *,
    settings: Config | None = None,
    dataset: str | Path,
    seed: int = 0,
    out: Path,
    device: str = "cpu",
    progress: Progress = silent,
) -> None:
    """Fit a method's grounding to a paired `dataset`; write it with its diagnostics and gap report to `out`.

    `settings` are the method's own, if it has any.

    Raises:
        BadInputError: the method does not ground, the dataset is not paired, `out` was begun with other
            settings, or a method of the user's makes no grounding that can be used.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import ground
        >>> from astra_data.grounding.fit import GroundConfig
        >>> ground("antmaze-umaze", "nas", GroundConfig(updates=2), dataset="pairs", out=Path("nas"))
    """
    fit = method_named(method).fit
    if fit is None:
        raise BadInputError(f"method '{method}' does not ground its simulator")
    world, made = task_named(task), origin(device)
    episodes = PairedEpisodes.load(dataset, device)
    episodes.check(world)
    training, held_out = episodes.split(config.held_out_share, seed)
    named = {"task": world.name, "method": method, **episodes.named}
    settings_text = as_json(**named, seed=seed, ground=config, settings=settings)
    made_from = {"dataset": episodes.content_hash}
    with finished_folder(out, config=settings_text, made_from=made_from) as folder:
        fit_progress = part(progress, 0.0, _FIT_SHARE)
        fitting = Fitting(world, config, settings, training, held_out, seed, device, folder, fit_progress)
        stopwatch = Stopwatch()
        with chdir("."):  # code of the user's may leave it
            grounding, metrics = fitted(fit(fitting))
        fit_end = stopwatch.spent()
        figures = made | fit_end | metrics
        try:
            Metrics.model_validate(figures)  # a fit of the user's may return any
        except ValidationError as error:
            raise BadInputError(
                f"the figures of fit: {faults_of(error)}: expected JSON values, such as those of value.tolist(), "
                "None for what is not known, and other names than those of reports"
            ) from None
        progress(_FIT_SHARE, "gap report")
        save_grounding(folder / GROUNDING, grounding, episodes)
        written = load_grounding(folder / GROUNDING, device)  # what policies are trained in
        if not is_of_package(base_method(method)):
            check_step(world, grounding, written, held_out)
        gap = gap_report(world, written, held_out, seed=seed)
        found = figures.get("failure_model")
        known = figures | ({"failure_model_latent": found.get("latent")} if isinstance(found, dict) else {})
        derived = {name: value for name in _DERIVED if isinstance(value := known.get(name), int | float)}
        progress(1.0, ", ".join(f"{name} {value:.4g}" for name, value in derived.items()) or "fitted")
        spent = stopwatch.spent()
        figures |= spent | {clock: figures[clock] + spent[clock] - fit_end[clock] for clock in CLOCKS}
        (folder / METRICS).write_text(json.dumps(figures, indent=1))
        (folder / GAP).write_text(json.dumps(gap, indent=1))
