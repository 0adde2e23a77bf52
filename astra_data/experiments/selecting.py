"""Choose among the policies of a run without the target: each is tried in simulators of other episodes."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from scipy.stats import spearmanr
from torch import Tensor

from astra_data.core.durable import make_folder, write_file
from astra_data.core.errors import BadInputError
from astra_data.core.naming import place, reference_of
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import derive
from astra_data.experiments.own_methods import add_all
from astra_data.experiments.plan import grounded_as
from astra_data.experiments.trained_policy import load_policy, settings_of
from astra_data.grounding.files import load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding
from astra_data.methods import method_named
from astra_data.reports.artefacts import EVALUATION, Evaluation, read_json
from astra_data.reports.formatting import table
from astra_data.training.deployment import DeployedPolicy
from astra_data.training.own_world import in_simulator, started
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

FOLDER = "select"
_QUANTILE = 0.25
"""Of the success over the judges, by which candidates are ranked: one that a single judge likes is a risk."""
_LEAST_SEEDS = 3
"""Of a row whose ranks are compared with those in the target."""


@dataclass(frozen=True)
class Judge:
    """A grounding of other episodes, and the factor (X, X) of the target's scatter around it."""

    grounding: FittedGrounding
    scatter: Tensor

    def simulator(self, task: Task, episodes: int) -> SimulatorEnv:
        """Return its simulator, in which its failure model ends episodes, if it has one."""
        made = self.grounding
        foresees = isinstance(made, HistoryGrounding) and made.failures is not None
        simulator = made.simulator(task, episodes, scatter=self.scatter)
        return SimulatorEnv(task.objective, simulator, topple=foresees)


@dataclass(frozen=True)
class Candidate:
    """A trained policy, and what it reached.

    Attributes:
        row, seed: which it is. success: by the seed of the judge, the share of the episodes that succeeded.
        target: the success in the target, where it was tested; it has no say in the choice.
    """

    row: str
    seed: int
    success: dict[int, float]
    target: float | None = None

    @property
    def predicted(self) -> float:
        """The mean success over the judges."""
        return fmean(self.success.values())

    @property
    def lower(self) -> float:
        """The lower quartile of the success over the judges."""
        return float(np.quantile([*self.success.values()], _QUANTILE))


def select(
    run: str | Path,
    *,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int = 100,
    progress: Progress = silent,
) -> list[Candidate]:
    """Try every trained policy of a run in groundings that were fitted to other episodes; rank them.

    A judge is the grounding of another seed of the run, which has episodes of its own. Its states are
    scattered as the target's are around it, and where it has a failure model, that ends episodes. Where a
    recipe has `data`, all seeds share their episodes, and the page says so. Writes `select/select.json` and
    `select/select.md` in the run's folder.

    Args:
        run: the folder of a run whose recipe has two seeds or more.
        rows: candidates; by default all rows of the recipe that have policies of abstract states.
        judge: the row whose groundings judge; by default the recipe's reference.
        episodes: of each policy with each judge.
        progress: called with the share done and a note.

    Returns:
        the candidates, best first: by the lower quartile over their judges, then by the mean.

    Raises:
        BadInputError: it is no run, a row is unknown or has no policy, or there are no two groundings.
    """
    folder, settings = Path(run), settings_of(run)
    add_all(settings.get("own_methods", {}))
    task, seeds = task_named(settings["task"]), [int(seed) for seed in settings["seeds"]]
    judging = judge or reference_of(tuple(settings["methods"]))
    judges = _judges(folder, judging, seeds)
    points = _points(folder, tuple(rows) or tuple(settings["methods"]), seeds)
    found = []
    for number, (row, seed) in enumerate(points):
        policy = load_policy(folder, row, seed=seed)
        success = {
            other: _success(task, one, policy, episodes, derive(other, f"judged: {seed}"))
            for other, one in judges.items()
            if other != seed
        }
        found.append(Candidate(row, seed, success, _in_target(folder, row, seed)))
        progress((number + 1) / len(points), f"{row}, seed {seed}: {found[-1].predicted:.2f}")
    ranked = sorted(found, key=lambda one: (one.lower, one.predicted), reverse=True)
    _write(folder, ranked, str(judging), episodes, shares_episodes=settings.get("data") is not None)
    return ranked


def worth(candidates: Sequence[Candidate]) -> dict[str, Any] | None:
    """Compare a ranking, best first, with the target; None where nothing was tested there.

    Returns:
        "rank_correlation": Spearman's, within rows of three seeds or more, a mean over rows, None without
        any; "regret": the best success in the target less that of the first; "random_regret": less the mean.
    """
    tested = [(one, one.target) for one in candidates if one.target is not None]
    if not tested:
        return None
    targets = [target for _, target in tested]
    correlations = []
    for row in dict.fromkeys(one.row for one, _ in tested):
        pairs = [(one.lower, target) for one, target in tested if one.row == row]
        lower, target = zip(*pairs, strict=True)
        if len(pairs) >= _LEAST_SEEDS and len(set(lower)) > 1 and len(set(target)) > 1:
            correlations.append(float(spearmanr(lower, target).statistic))
    return {
        "rank_correlation": fmean(correlations) if correlations else None,
        "regret": max(targets) - targets[0],
        "random_regret": max(targets) - fmean(targets),
    }


def _judges(folder: Path, row: str | None, seeds: Sequence[int]) -> dict[int, Judge]:
    """Return the groundings of a row, by their seeds."""
    if row is None or not method_named(row).grounds:
        found = row or "none"
        raise BadInputError(f"{folder}: expected a row that grounds its simulator as judge, got {found}")
    files = {
        seed: folder / "ground" / grounded_as(row) / place(seed, None) / "grounding.safetensors"
        for seed in seeds
    }
    made = {seed: load_grounding(file) for seed, file in files.items() if file.is_file()}
    if len(made) < 2:
        raise BadInputError(
            f"{folder}: expected groundings of {row} for two seeds or more, found {len(made)}: a policy is "
            "judged by those that were fitted to other episodes; add seeds to the recipe and run it"
        )
    return {
        seed: Judge(one, one.scatter(PairedEpisodes.load(folder / "pair" / place(seed, None))))
        for seed, one in made.items()
    }


def _points(folder: Path, rows: Sequence[str], seeds: Sequence[int]) -> list[tuple[str, int]]:
    """Return the rows and seeds whose policies act on abstract states and are there."""
    able = [row for row in rows if method_named(row).trains and not method_named(row).steps_target]
    found = [
        (row, seed)
        for row in able
        for seed in seeds
        if (folder / "train" / row / place(seed, None) / "policy.safetensors").is_file()
    ]
    if not found:
        named = ", ".join(rows)
        raise BadInputError(f"{folder}: found no policy of {named}: run the recipe until train first")
    return found


def _success(task: Task, judge: Judge, policy: DeployedPolicy, episodes: int, seed: int) -> float:
    """Return the share of the episodes with a judge in which a policy succeeds."""
    begin = partial(started, policy, policy.act_in_simulator)
    outcome, _ = in_simulator(judge.simulator(task, episodes), begin, task.objective.horizon, seed)
    return fmean(outcome.success)


def _in_target(folder: Path, row: str, seed: int) -> float | None:
    file = folder / "evaluate" / row / place(seed, None) / EVALUATION
    if not file.is_file():
        return None
    tested = read_json(Evaluation, file).target
    return None if tested is None else fmean(tested.success)


def _write(
    folder: Path, ranked: Sequence[Candidate], judge: str, episodes: int, *, shares_episodes: bool
) -> None:
    make_folder(folder / FOLDER)
    compared = worth(ranked)
    candidates = [asdict(one) | {"predicted": one.predicted, "lower": one.lower} for one in ranked]
    record = {"judge": judge, "episodes": episodes, "candidates": candidates, "worth": compared}
    write_file(folder / FOLDER / "select.json", json.dumps(record, indent=1))
    head = ["row", "seed", "lower quartile", "mean", "judges", "success in the target"]
    lines = [
        [
            *(one.row, f"{one.seed}", f"{one.lower:.2f}", f"{one.predicted:.2f}", f"{len(one.success)}"),
            "-" if one.target is None else f"{one.target:.2f}",
        ]
        for one in ranked
    ]
    of = "the same episodes, from other seeds" if shares_episodes else "the episodes of other seeds"
    text = [
        f"# {folder.name}: a choice without the target",
        f"Success in {episodes} episodes in the groundings of {judge} that were fitted to {of}, with the "
        "scatter of the target around them. Ranked by the lower quartile over these.",
    ]
    if shares_episodes:
        text.append(
            "All seeds of this run have the same episodes, so no judge is independent of what it judges: an "
            "error that all groundings share is not seen."
        )
    text.append(table(head, lines, words=1))
    if compared is not None:
        correlation = compared["rank_correlation"]
        known = "not known (fewer than three seeds)" if correlation is None else f"{correlation:.2f}"
        text.append(
            f"Rank correlation with the target within rows: {known}. Regret of the first: "
            f"{compared['regret']:.2f}; of one drawn at random: {compared['random_regret']:.2f}."
        )
    write_file(folder / FOLDER / "select.md", "\n\n".join(text) + "\n")
