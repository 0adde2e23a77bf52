"""Results → sections of a page: a column of the table of methods is a line of `COLUMNS`, by a stage's measure."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from astra_data.core.naming import base_method, in_code, is_plus, reference_of
from astra_data.core.progress import CLOCKS
from astra_data.methods import grounded_as, method_named, method_role, method_title
from astra_data.reports.blocks import Block, Code, Section, TableBlock, Text, duration
from astra_data.reports.choice import choice_blocks, trial_blocks
from astra_data.reports.figures.catalog import pictures
from astra_data.reports.held_out import gap_blocks
from astra_data.reports.results import SIMULATED, TESTED, WHOLE, Origin, Results, elapsed_seconds, stage_seconds, titled
from astra_data.reports.runs import DATASET_STAGES, SHARED_WORLDS
from astra_data.reports.statistics import LEAST_SEEDS, correlation, ends, interval, probability_of_improvement, spread
from astra_data.reports.verdict import verdict_of

COSTED = ("ground", "train", "align", "evaluate")  # stages that run once for each method and seed
LEAST_POLICIES = 5  # policies below which no correlation over them is shown
WORDS = {
    "astra": "ASTRA: the paper's correction, prediction of rewards and aligned encoder",
    "nas": "NAS: neural-augmented simulation, a correction of the simulator's next state alone",
    "iql": "IQL: implicit Q-learning, from the recorded steps alone",
    "rma": "RMA: rapid motor adaptation",
    "compass": "COMPASS: simulator parameters drawn uniformly from the wide ranges that the paper prints",
}  # what the names of methods stand for


@dataclass(frozen=True)
class PageColumn:
    """A column of the table of methods, left out where none has more than `negligible`; `note` explains its title."""

    measure: str
    title: str
    digits: int
    note: str = ""
    negligible: float = 0.0
    where: str = TESTED


COLUMNS = (
    PageColumn("failed", "failed", 2, "Failed: share of episodes that ended in a failure, such as a fall."),
    PageColumn("wall_contact", "wall contact", 2, "Wall contact: share of steps."),
    PageColumn("steps", "steps", 0),
    PageColumn("distance", "path length to success (m)", 1),
    PageColumn("return", "return", 1, negligible=-np.inf),
    PageColumn("tries", "training runs", 1, negligible=1.0, where="train"),
    PageColumn(
        "beyond_recorded",
        "beyond recorded commands",
        2,
        "Beyond recorded commands: share of steps whose command is outside the recorded range. The data "
        "does not show what such commands do: narrow the bounds of the task's commands, or record more.",
        negligible=0.01,
    ),
)


def sections_of(results: Results, run: str) -> list[Section]:
    """Return the sections of the page of results, whose run is in the folder `run`."""
    sections = [
        Section("", [*_facts(results)]),
        Section("Verdict", [*_verdict(results, run)]),
        Section("Methods", [*_methods(results)]),
        Section("The gap", [*_gap(results), *_validity(results)]),
    ]
    if results.percents != [WHOLE]:
        sections.append(Section("Size of the data", [*_sizes(results)]))
    if choice := results.choice():
        sections.append(Section("Chosen without the target", choice_blocks(choice, shown=8)))
        if results.trials:
            sections.append(Section("Trials in the target", trial_blocks(choice.judged, results.trials)))
    return [
        *sections,
        Section("Training and cost", [*pictures(results, "training"), *_costs(results)]),
        Section("Every seed", [*_every_seed(results)]),
        Section("Provenance", [*_provenance(results)]),
    ]


def _facts(results: Results) -> Iterator[Block]:
    if results.warning:
        yield Text(results.warning, warns=True)
    if results.stand_in:
        yield Text(
            f"**A simulated stand-in ({in_code(results.stand_in)}) replaces the physical robot: no number is "
            "from a real robot, and none is comparable to one in absolute terms.**",
            warns=True,
        )
    seeds = ", ".join(map(str, results.seeds))
    text = f"Task {in_code(results.task)}, seeds {seeds}, {results.episodes} episodes per method and seed"
    if results.largest != WHOLE:
        text += f"; unless stated otherwise, with {results.largest} % of the data"
    text += "."
    if results.leg_scale != 1:
        text += f" The target's legs are {results.leg_scale:g} times as long."
    unfinished = [
        f"{', '.join(map(method_title, lacking))}{f' at {percent} %' if results.is_swept else ''}"
        for percent in results.percents
        if (lacking := [row for row in results.rows if row not in results.tested(percent)])
    ]
    sizes, asked = results.sizes, results.settings.get("seeds")
    for words, wanted, made in (("{} % of the data", sizes, results.percents), ("seeds {}", asked, results.seeds)):
        if lacking := [str(one) for one in wanted if one not in made] if isinstance(wanted, list) else []:
            unfinished.append(words.format(", ".join(lacking)))
    if unfinished:
        text += f" Not finished yet: {'; '.join(unfinished)}."
    yield Text(text)


def _verdict(results: Results, run: str) -> Iterator[Block]:
    verdict = verdict_of(results)
    yield Text(verdict.text)
    items = [f"**{label.capitalize()}**: {text}" for label, text in verdict.lines]
    yield Text("", [*items, *verdict.remarks])
    if command := verdict.command(run):
        yield Code(command)


def _methods(results: Results) -> Iterator[Block]:
    rows, where, headline = results.tested(), results.where, results.headline
    columns: list[tuple[str, list[str]]] = []
    for score in results.scores:
        for title, write in ((f"{score.title} {where}", spread), ("95 % interval", ends)):
            columns.append((title, [write(results.summary(row, score.measure), score.digits) for row in rows]))
    if printed := results.paper_success:
        columns.append(("paper", [f"{printed[row]:.2f}" if row in printed else "-" for row in rows]))
    learned = [results.score_of(row, SIMULATED) for row in rows]
    columns.append(("in its simulator", [spread(one, headline.digits) for one in learned]))
    lost = [
        f"{one.value - there.value:z.{headline.digits}f}" if one and there else "-"
        for one, there in zip(learned, map(results.score_of, rows), strict=True)
    ]
    columns.append(("lost", lost))
    shown = [column for column in COLUMNS if _is_shown(results, column)]
    for column in shown:
        if column.measure not in {score.measure for score in results.scores}:
            found = [results.summary(row, column.measure, column.where) for row in rows]
            columns.append((column.title, [spread(one, column.digits) for one in found]))
    columns.append(("seeds", [f"{len(results.values(row, headline.measure))}" for row in rows]))
    scores = {row: one.value for row in results.contenders() if (one := results.score_of(row))}
    best = max(scores, key=lambda row: scores[row], default=None)
    names = [f"**{titled(row)}**" if row == best else titled(row) for row in rows]
    lines = [*zip(names, *(cells for _, cells in columns), strict=True)]
    yield TableBlock("", ["method", *(title for title, _ in columns)], lines)
    notes = [
        f"Mean ± standard deviation over seeds, {where}, and the 95 % interval of the mean (Student's t, "
        f"for shares of episodes widened to Wilson's), which needs {LEAST_SEEDS} seeds.",
        f"In its simulator: the same policies in the simulator of their training; lost: how much less it is {where}.",
        *(column.note for column in shown if column.note),
        "Floor: what is reached without any correction. Ceiling: what a controller reaches that knows the "
        "task. The best of the other methods is bold.",
    ]
    if any(method_role(row) == "trained there" for row in rows):
        notes.append("Methods marked “trained there” learned in the target, for as long as the recipe says.")
    if any(map(is_plus, rows)):
        notes.append("A plus sign marks the same method trained with the plus settings.")
    if results.paper_success:
        notes.append(
            "The paper's success rates come from its own robot, maze and tuning, which it does not print in "
            "full: compare their order, not their values."
        )
    yield Text(" ".join(notes), [WORDS[name] for name in WORDS if name in map(base_method, rows)])
    yield from _comparisons(results)
    yield from _encoders(results)
    yield from pictures(results, "methods")


def _is_shown(results: Results, column: PageColumn) -> bool:
    """Return whether a method has values of a column to speak of: a robot without walls touches none."""
    found = [results.summary(row, column.measure, column.where) for row in results.tested()]
    return any(one is not None and one.value > column.negligible for one in found)


def _comparisons(results: Results) -> Iterator[Block]:
    """Yield how methods of `compare` do against all others trained alike (with the plus settings or without)."""
    headline, lines = results.headline, []
    rows = [row for row in results.tested() if method_role(row) in (None, "floor")]
    scores = {row: np.array([*results.values(row, headline.measure).values()]) for row in rows}
    for row, other in permutations(rows, 2):
        is_alike = is_plus(other) == is_plus(row) or not results.values(other, "success", SIMULATED)
        if base_method(row) in map(base_method, results.compare) and is_alike:
            better = probability_of_improvement(scores[row], scores[other])
            if better and (by := results.difference(row, other)):
                shown = (interval(better), interval(by, headline.digits))
                lines.append([method_title(row), method_title(other), *shown])
    head = ["method", "beats", "probability [95 %]", "difference, paired by seed [95 %]"]
    yield TableBlock("Probability of improvement", head, lines, words=2)
    if lines:
        yield Text(
            f"Probability that a seed of the first method has a higher {headline.quantity} than a seed of "
            "the second; ties count half; its interval is a bootstrap over seeds. The difference is the "
            "mean over the seeds that both have, which share data, starts and goals, with Student's t "
            "interval. Only methods that are trained alike are compared."
        )


def _encoders(results: Results) -> Iterator[Block]:
    places = sorted({line.where for line in results.lines if line.where.startswith("encoder ")})
    lines = [
        [method_title(row), place.removeprefix("encoder "), *(spread(one, digits) for one, digits in found)]
        for row in results.tested()
        for place in places
        for found in [[(results.summary(row, of.measure, place), of.digits) for of in results.scores]]
        if any(one for one, _ in found)
    ]
    title = "The same policy with the simulator's encoder (source) or with the one aligned to the target"
    yield TableBlock(title, ["method", "encoder", *(score.title for score in results.scores)], lines, words=2)


def _gap(results: Results) -> Iterator[Block]:
    if results.errors:
        yield Text(
            "How far simulators drift from the target on held-out episodes when they start in its state and "
            "receive its actions: mean [95 % interval over episodes], averaged over seeds."
        )
    yield from (*gap_blocks(results), *pictures(results, "failures"), *pictures(results, "gap"))


def _validity(results: Results) -> Iterator[Block]:
    """Yield how well returns in a simulator predict those in the target."""
    lines, is_few = [], False
    for world in SHARED_WORLDS if results.tested_in == "target" else ():
        pairs = [
            np.array([[there[seed], values[seed]] for seed in there if seed in values]).T
            for row in results.tested()
            if (there := results.values(row, "return", world)) and (values := results.values(row, "return"))
        ]
        policies = sum(pair.shape[1] for pair in pairs)
        if policies >= LEAST_POLICIES:
            sides = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
            found = [correlation(*sides, ranks=ranks) for ranks in (False, True)]
            lines.append([world, f"{policies}", *map(interval, found)])
        is_few |= 0 < policies < LEAST_POLICIES
    title = "Does a simulator show which policy is better? Correlation with the return in the target"
    yield TableBlock(title, ["simulator", "policies", "Pearson [95 %]", "Spearman [95 %]"], lines)
    if lines:
        reference = reference_of(results.rows)
        grounding = f"{method_title(reference)}'s, of the same seed" if reference else "each method's own"
        yield Text(
            "Each method and seed is one policy, tested from the task's starts with the task's reward. "
            f"Intervals resample methods, and seeds within each. The grounding is {grounding}."
        )
    elif is_few:
        yield Text(f"No correlation of returns is shown: it needs {LEAST_POLICIES} policies.")
    yield from pictures(results, "validity") if lines else ()


def _sizes(results: Results) -> Iterator[Block]:
    score, seeds = results.headline, len(results.seeds)
    head = ["method", *(f"{percent} %" for percent in results.percents)]
    means, intervals = [], []
    for row in results.tested():
        found = [results.score_of(row, percent=percent) for percent in results.percents]
        few = [f" ({one.seeds} of {seeds} seeds)" if one and one.seeds != seeds else "" for one in found]
        title = method_title(row)
        means.append([title, *(f"{spread(one, score.digits)}{of}" for one, of in zip(found, few, strict=True))])
        intervals.append([title, *(ends(one, score.digits) for one in found)])
    title = f"{score.title.capitalize()} {results.where}, mean ± standard deviation over seeds"
    yield TableBlock(title, head, means)
    yield TableBlock("95 % interval of the mean", head, intervals)
    yield from pictures(results, "sizes")
    lines = []
    for percent in results.percents:
        if choice := results.choice(percent):
            known = (choice.target(choice.best), choice.regret, choice.random_regret)
            cells = ("-" if value is None else f"{value:z.2f}" for value in known)
            predicted = interval(choice.judged.estimate(choice.best))
            lines.append([f"{percent} %", choice.best.name, predicted, *cells])
    head = ["size", "chosen", "predicted [95 %]", "in the target", "regret", "regret at random"]
    yield TableBlock("Chosen without the target, by the groundings of other seeds", head, lines, words=2)


def _costs(results: Results) -> Iterator[Block]:
    wall, cpu = (stage_seconds(results, clock) for clock in CLOCKS)
    stages = (*DATASET_STAGES, "ground", "train", "align", "select", "evaluate")
    lines = [[of, duration(wall[of]), duration(cpu.get(of))] for of in stages if of in wall]
    elapsed = elapsed_seconds(results)
    total = ["whole recipe", duration(sum(wall.values())), duration(sum(cpu.values()) or None)]
    yield Text(f"Wall time of the whole recipe: {duration(elapsed)}, in which several stages may run at once.")
    title = "Time of each stage, added up over methods and seeds"
    yield TableBlock(title, ["stage", "time", "CPU time"], [*lines, total])
    per_row = []
    for row in results.tested():
        found, spent = ([_cost(results, stage, row, clock) for stage in COSTED] for clock in CLOCKS)
        sums = [sum(filter(None, of)) or None for of in (found, spent)]
        per_row.append([method_title(row), *map(duration, found + sums)])
    head = ["method", *COSTED, "in all", "CPU time"]
    yield TableBlock("Time for one seed of each method, with the grounding and alignment that it uses", head, per_row)
    yield Text("A dash: no time was recorded. CPU time: of all threads.")


def _cost(results: Results, stage: str, row: str, clock: str) -> float | None:
    """Return the mean time of a stage for one seed of a method, with the training it starts from."""
    initial = method_named(row).initial if stage == "train" else None
    owners = filter(None, (grounded_as(row) if stage in ("ground", "align") else row, initial))
    known = [found.value for owner in owners if (found := results.summary(owner, clock, stage))]
    return sum(known) if known else None


def _every_seed(results: Results) -> Iterator[Block]:
    found = [line for line in results.lines if line.where == TESTED and line.row in results.rows]
    left_out, swept = [one.measure for one in COLUMNS if not _is_shown(results, one)], results.is_swept
    measures = dict.fromkeys(name for line in found for name in line.values if name not in left_out)
    lines = []
    for line in sorted(found, key=lambda line: results.rows.index(line.row)):
        cells = [f"{line.values[name]:.4g}" if name in line.values else "-" for name in measures]
        lines.append([method_title(line.row), *([f"{line.percent} %"] if swept else []), f"{line.seed}", *cells])
    names = [name.replace("_", " ") for name in measures]
    yield TableBlock("", ["method", *(["size"] if swept else []), "seed", *names], lines, words=1 + swept)


def _provenance(results: Results) -> Iterator[Block]:
    yield Text("Produced by")
    yield Code(results.command)
    items = []
    for number, what in enumerate(("Code", "Machine", "Versions")):
        stages: dict[str, list[str]] = {}
        for origin in results.origins:
            stages.setdefault(_described(origin)[number], []).extend(origin.stages)
        # What all stages share stands alone.
        texts = [f"{text} ({', '.join(dict.fromkeys(of))})" for text, of in stages.items()]
        items.append(f"{what}: {'; '.join(texts if len(stages) > 1 else stages)}.")
    if results.user_code:
        digests = [f"{name} `{digest.replace(' and ', '` and `')}`" for name, digest in results.user_code.items()]
        items.append(f"User code: {', '.join(digests)}.")
    uses: dict[tuple[str, str, str], list[str]] = {}
    for one in results.datasets:
        key = (one.stage, one.name, one.version)
        uses.setdefault(key, []).append(f"`{one.content_hash}` (seed {one.seed})")
    for (stage, name, version), contents in uses.items():
        named = " ".join(filter(None, (name, version)))
        what = "Dataset named by evaluations" if stage == "evaluate" else f"Dataset of `{stage}`"
        items.append(f"{what}: {named}, content {', '.join(contents)}.")
    yield Text("", items)
    text = "With this machine and these versions, the same seeds give the same numbers."
    yield Text(f"{text} All numbers and settings are in `results.json`.")


def _described(origin: Origin) -> tuple[str, str, str]:
    commit, on = (origin.commit or "").removesuffix("-dirty"), origin.machine
    changed = " with uncommitted changes" if commit != origin.commit else ""
    code = f"commit `{commit}`{changed}" if commit else "not recorded"
    gpu = f", {on.gpu}" if on and on.gpu else ""
    machine = f"{on.cpu}, {on.cores} cores, {on.memory_gib:g} GiB of memory{gpu}" if on else "not recorded"
    versions = [f"{name} {version}" for name, version in origin.packages.items() if version is not None]
    return code, machine, ", ".join(versions) or "not recorded"
