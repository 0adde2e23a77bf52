"""Select: choose among a recipe's policies without the target, by groundings of other seeds, the judges."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean

from astra_data.core.artifact import check_made_from, finished_folder
from astra_data.core.config import AtOnce, Config
from astra_data.core.durable import file_digest, write_file
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.naming import artifact_key, reference_of
from astra_data.core.progress import Progress, Stopwatch, silent
from astra_data.core.provenance import origin
from astra_data.core.seeding import derive
from astra_data.grounding.files import GROUNDING, grounding_at, load_grounding
from astra_data.methods import grounded_as, method_named
from astra_data.policies.episodes import judged_from, judged_success
from astra_data.policies.running_policy import POLICY, PolicyFile, RunningPolicy, running
from astra_data.reports.choice import FOLDER, PAGE, SELECTED, Candidate, Judged, select_page
from astra_data.reports.runs import Reported
from astra_data.robots.registry import task_named

_BEGUN = "begun.json"  # digests of a policy and of its judge → success, of a choice that was interrupted


class SelectConfig(Config):
    """How policies are chosen without the target."""

    episodes: AtOnce = 100
    """Episodes of each policy with each judge, run in one batch."""
    judge: str | None = None
    """Row whose groundings serve as judges; by default NAS, or else the first row that grounds."""


@dataclass(frozen=True)
class Entry:
    """A policy to judge: the keys of its artifacts in a run's folder; `grounding` is None without one."""

    row: str
    seed: int
    policy: str
    grounding: str | None

    def load(self, root: Path, task: str) -> RunningPolicy:
        """Return the policy, with the encoder of its own grounding."""
        policy, grounding = root / self.policy / POLICY, self.grounding and root / self.grounding / GROUNDING
        check_made_from(policy, {"grounding": file_digest(grounding) if grounding else None})
        return running(task_named(task), PolicyFile.load(policy), grounding_at(grounding or None))


@dataclass(frozen=True)
class Bench:
    """Who is judged by whom at one size of the dataset: seeds of judges → the keys of their groundings."""

    percent: int | None
    entries: tuple[Entry, ...]
    judges: dict[int, str]

    @property
    def keys(self) -> tuple[str, ...]:
        """The artifacts that are read, each once."""
        read = [key for one in self.entries for key in (one.policy, one.grounding) if key]
        return tuple(dict.fromkeys([*read, *self.judges.values()]))

    def finished(self, root: Path) -> "Bench":
        """Return those whose artifacts are in a run's folder."""
        grounded = {None} | {key for key in self.keys if (root / key / GROUNDING).is_file()}
        trained = [one for one in self.entries if (root / one.policy / POLICY).is_file()]
        judges = {seed: key for seed, key in self.judges.items() if key in grounded}
        return Bench(self.percent, tuple(one for one in trained if one.grounding in grounded), judges)


def judge_of(judge: str | None, rows: Sequence[str]) -> str:
    """Return the method whose groundings judge `rows`, by default the reference, or the first that grounds."""
    grounding = (row for row in rows if method_named(row).grounds)
    asked = judge or reference_of(rows) or next(grounding, None)
    if asked is None or not method_named(asked).grounds:
        expected = "expected a row that grounds its simulator, such as nas or astra, as judge"
        raise BadInputError(f"{expected}, got {asked or 'none'}")
    return grounded_as(asked)


def judge_in(recipe: Reported, config: SelectConfig) -> str:
    """Return the judge of all policies of a recipe, of which only some rows may be reported."""
    return judge_of(config.judge, recipe.settings["methods"])  # type: ignore[arg-type]


def benches(recipe: Reported, judge: str) -> list[Bench]:
    """Return who is judged by whom, at each size; policies that do not act on abstract states are not."""
    rows, found = [row for row in recipe.methods if method_named(row).trains_without_target], []
    for size in recipe.percents or (None,):
        judges = {seed: artifact_key("ground", judge, seed, size) for seed in recipe.seeds}
        entries = []
        for row, seed in product(rows, recipe.seeds):
            grounding = artifact_key("ground", grounded_as(row), seed, size) if method_named(row).grounds else None
            entries.append(Entry(row, seed, artifact_key("train", row, seed, size), grounding))
        found.append(Bench(size, tuple(entries), judges))
    return found


def digests(of: list[Bench], root: Path) -> dict[str, str]:
    """Return the digest of each artifact that is read, by its key."""
    keys = dict.fromkeys(key for bench in of for key in bench.keys)
    files = {key: root / key / (POLICY if key.startswith("train/") else GROUNDING) for key in keys}
    return {key: file_digest(file) for key, file in files.items()}


def predicted_from(
    recipe: Reported, config: SelectConfig, one: Candidate, state: Tensor, goal: Tensor, *, root: Path
) -> list[float]:
    """Return a candidate's success with its judges from each of N states (N, X) with goals (N, G), as shares (N,)."""
    bench = next(of for of in benches(recipe, judge_in(recipe, config)) if of.percent == one.percent)
    entry = next(of for of in bench.entries if (of.row, of.seed) == (one.row, one.seed))
    policy, found = entry.load(root, recipe.task), list[Tensor]()
    for seed in one.success:
        judge = load_grounding(root / bench.judges[seed] / GROUNDING)
        found.append(judged_from(policy.task, judge, policy, state, goal, derive(seed, f"predicted: {entry.seed}")))
    predicted: list[float] = torch.stack(found).mean(0).tolist()
    return predicted


def select(recipe: Reported, config: SelectConfig = SelectConfig(), *, root: Path, progress: Progress = silent) -> None:
    """Try every finished policy of a recipe in groundings of other seeds; write `root`/select, ranked, by size."""
    judge = judge_in(recipe, config)
    contests = [bench.finished(root) for bench in benches(recipe, judge)]
    for bench in contests:
        size = f" at {bench.percent} %" if bench.percent else ""
        if not bench.entries:
            named = ", ".join(recipe.methods)
            raise BadInputError(f"{root}: found no policy of {named}{size}: run the recipe until train first")
        if len(bench.judges) < 2:
            advice = "groundings of other episodes judge a policy: add seeds to the recipe and run it"
            fault = f"expected groundings of {judge} for two seeds or more{size}, found {len(bench.judges)}"
            raise BadInputError(f"{root}: {fault}: {advice}")
    made_from, stopwatch = digests(contests, root), Stopwatch()
    total, found = sum(len(bench.entries) for bench in contests), list[Candidate]()
    settings_text = config.model_dump_json(indent=1)
    with finished_folder(root / FOLDER, config=settings_text, made_from=made_from) as folder:
        begun = folder / _BEGUN
        known: dict[str, float] = json.loads(begun.read_text()) if begun.is_file() else {}
        for bench in contests:
            judges = {seed: load_grounding(root / key / GROUNDING) for seed, key in bench.judges.items()}
            for entry in bench.entries:
                policy, success = entry.load(root, recipe.task), dict[int, float]()
                others = [seed for seed in bench.judges if seed != entry.seed]
                for number, other in enumerate(others, start=1):
                    read = f"{made_from[entry.policy]}/{made_from[bench.judges[other]]}"
                    if read not in known:
                        drawn = derive(other, f"judged: {entry.seed}")
                        known[read] = judged_success(policy.task, judges[other], policy, config.episodes, drawn)
                        write_file(begun, json.dumps(known))
                    success[other] = known[read]
                    note = f"{entry.row}, seed {entry.seed}: {fmean(success.values()):.2f}"
                    progress((len(found) + number / len(others)) / total * 0.99, note)
                found.append(Candidate(row=entry.row, seed=entry.seed, percent=bench.percent, success=success))
        shares, made = recipe.settings.get("data") is not None, origin() | stopwatch.spent()
        judged = Judged(judge=judge, episodes=config.episodes, shares_episodes=shares, candidates=found, **made)
        begun.unlink()
        (folder / SELECTED).write_text(judged.model_dump_json(indent=1))
        (folder / PAGE).write_text(select_page(recipe.name, judged))
    first = judged.ranked(judged.percents[-1])[0]
    progress(1.0, f"{first.row}, seed {first.seed}: {first.lower:.2f} in the lower quartile of its judges")
