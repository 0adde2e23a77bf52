"""Results → Markdown: tables, figures and how to read them."""

from collections.abc import Mapping

from astra_data.core.naming import is_plus, reference_of
from astra_data.methods import ROLES, method_title
from astra_data.reports.cost_and_origin import cost, machine, origin
from astra_data.reports.formatting import duration, interval, mean_std, spread, table
from astra_data.reports.schema import BandMeans, Results
from astra_data.worlds.score import SUCCESS

_BARS = "Bars are interquartile means over seeds, dots single seeds, lines 95 % bootstrap intervals."
_DIAMONDS = (
    " A diamond is the same policy in the simulator that it was trained in: the drop from diamond to bar "
    "is what the transfer costs."
)

HOW_TO_READ = {
    "success": _BARS + _DIAMONDS,
    "steps": _BARS + _DIAMONDS,
    "return": _BARS,
    "trajectories": (
        "Orange, dashed: the policy in the simulator that it was trained in. Blue: the same policy in the "
        "target. An episode that fails ends with a cross, one that succeeds at the star, its goal. Starts "
        "and goals are drawn apart in the two worlds, so the lines are no pairs: compare the ways that they "
        "take and where they end. The number is the success rate in the target over all episodes and seeds."
    ),
    "strips": (
        "Pictures of the target at the times above them, of the first evaluation episode of the first seed; "
        "all rows begin alike. A row of pictures ends where its episode does."
    ),
    "mismatch": (
        "The same commands in the ungrounded simulator (orange) and, repeatedly, in the target (blue: "
        "mean; bands: 25 to 75 % and 5 to 95 %). Where they part, the simulator lacks something."
    ),
    "learning": (
        "Share of the training episodes that reach the goal, in the simulator that the policy is trained in: "
        "mean over seeds, band from the worst seed to the best; dashed with the `[plus]` settings. With "
        "`data_start_share` in the recipe that share of the episodes starts in the midst of a recorded "
        "trajectory, often nearer to the goal, so these figures are no success rates of the task; those are "
        "in the table. High here and low there means that the policy learned what the target does not do."
    ),
    "learning_steps": (
        "Steps that the training episodes last, in the simulator that the policy is trained in: mean over "
        "seeds, band from the worst seed to the best; dashed with the `[plus]` settings. They are cut off "
        "after `episode_steps` where the recipe sets that, and with `data_start_share` that share of them "
        "starts in the midst of a recorded trajectory, so these figures are not the task's; those are in the "
        "table. High here and low there means that the policy learned what the target does not do."
    ),
    "validity": (
        "A dot is one policy: a row's seed, with its mean return over the episodes. On the dashed line the "
        "simulator foretells the target's return exactly; what counts for choosing between policies is that "
        "better in the simulator is better in the target."
    ),
    "gap": (
        "The simulator is given the target's actions from a target state on; the error is its distance "
        "from what the target did. Bands are each seed's 95 % interval over episodes, averaged over "
        "seeds. Lower is better; dotted is no grounding."
    ),
}
"""The text under each figure, in the order of the page."""

BESIDE = {
    "success": ("failed", "wall_contact", "steps", "distance", "return", "simulated_success"),
    "steps": ("failed", "simulated_steps"),
}
"""Headline → the measures that the table tells beside the scores."""

EXPLAINED = {
    "success": "Wall contact: share of steps.",
    "steps": "Survived steps: until an episode fails or its time is up.",
}
"""Headline → what else its table needs said."""

COLUMNS = {
    "failed": ("failed", 2),
    "wall_contact": ("wall contact", 2),
    "steps": ("steps", 0),
    "distance": ("way to success in m", 1),
    "return": ("return", 1),
    "simulated_success": ("success in its simulator", 2),
    "simulated_steps": ("survived steps in its simulator", 0),
}
"""Head and digits of such a measure."""

CAPTIONS = {
    "success": "Success in the target",
    "steps": "Survived steps in the target",
    "return": "Return in the target",
    "trajectories": "Trajectories",
    "strips": "The first episode of each row",
    "mismatch": "The same commands in simulator and target",
    "learning": "Learning curves",
    "learning_steps": "Learning curves",
    "validity": "Return in the simulators and in the target",
    "gap": "Open-loop error by horizon",
}


def render(results: Results, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        results: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `HOW_TO_READ`.
    """
    sections = [_head(results), _table(results), _comparison(results), _encoders(results)]
    sections += [_figure(score.measure, figures) for score in results.scores]
    for name in ("trajectories", "strips", "mismatch", "learning", "learning_steps"):
        sections.append(_figure(name, figures))
    sections += [_gap(results), _figure("gap", figures), _validity(results), _figure("validity", figures)]
    sections += [cost(results), origin(results)]
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(results: Results) -> str:
    stages = [made for made in results.origins if made.machine and made.stages != ["report"]]
    machines = " and ".join(dict.fromkeys(machine(made) for made in stages))
    seeds = ", ".join(str(seed) for seed in results.seeds)
    if any(row.seeds != results.seeds for row in results.methods.values()):
        seeds += " (rows have as many of them as the table says)"
    to_come = f" Not finished yet: {', '.join(results.unfinished)}." if results.unfinished else ""
    stand_in = (
        f"\n\n**A simulated stand-in (`{results.stand_in}`) takes the physical robot's place: no figure is "
        "of a real robot, and none compares with one in absolute terms.**"
        if results.stand_in
        else ""
    )
    legs = f" The target's legs are {results.leg_scale:g} times as long." if results.leg_scale != 1 else ""
    return (
        f"# {results.recipe}\n\n"
        f"Task `{results.task}`, seeds {seeds}, {results.episodes} episodes per row and seed.{legs} "
        f"Produced by\n\n"
        f"```\n{results.command}\n```\n\n"
        f"on {machines or 'a machine that was not recorded'}. "
        f"Wall time of the stages, summed: {duration(results.wall_seconds['total'])}.{to_come}{stand_in}"
    )


def _table(results: Results) -> str:
    rows, scores, beside = results.methods, results.scores, BESIDE[results.headline.measure]
    best = {
        score: max((row.summary[score.measure].mean for row in rows.values() if not row.role), default=None)
        for score in scores
    }
    head = ["method", "seeds"]
    for score in scores:
        head += [score.title, "IQM [95 %]"]
    head += [COLUMNS[measure][0] for measure in beside]
    lines = []
    for row in rows.values():
        cells = [f"{row.title} ({row.role})" if row.role else row.title, str(len(row.seeds))]
        for score in scores:
            summary = row.summary[score.measure]
            mean = spread(summary, score.digits)
            cells.append(f"**{mean}**" if not row.role and summary.mean == best[score] else mean)
            cells.append(interval(summary.iqm, summary.low, summary.high, score.digits))
        cells += [
            spread(row.summary[measure], COLUMNS[measure][1]) if measure in row.summary else "-"
            for measure in beside
        ]
        lines.append(cells)
    note = (
        "Mean ± standard deviation over seeds, in the target. IQM: interquartile mean over seeds with its "
        "95 % stratified bootstrap interval. Failed: share of episodes that ended badly, as in a fall. "
        f"{EXPLAINED[results.headline.measure]} Floor and ceiling bound the other rows; the best of those is "
        "bold."
    )
    if any(row.role == ROLES["target"] for row in rows.values()):
        note += " Rows that were trained there learned in the target itself, for as long as the recipe says."
    if any(map(is_plus, rows)):
        note += " A plus marks the same method trained with the recipe's `[plus]` settings."
    paper = results.paper_success
    if paper:
        place = head.index(SUCCESS.title) + 1
        head.insert(place, "the paper's")
        for method, cells in zip(rows, lines, strict=True):
            cells.insert(place, f"{paper[method]:.2f}" if method in paper else "-")
        note += (
            " The paper's success rates are of its own robot, maze and tuning, which it does not print in "
            "full: their order can be compared, their heights cannot."
        )
    return f"## Results\n\n{table(head, lines)}\n\n{note}"


def _comparison(results: Results) -> str:
    rows = results.methods
    lines = [
        [rows[ours].title, rows[other].title, interval(found.probability, found.low, found.high)]
        for ours, over in results.probability_of_improvement.items()
        for other, found in over.items()
    ]
    if not lines:
        return ""
    note = (
        f"How likely a seed of the one has a higher {results.headline.quantity} than a seed of the other; "
        "ties count half. Only rows that are trained alike are compared: all with the `[plus]` settings, or "
        "all without; rows that are trained in no simulator, which those settings are for, with both."
    )
    head = ["row", "beats", "probability [95 %]"]
    return f"## Probability of improvement\n\n{table(head, lines, words=2)}\n\n{note}"


def _encoders(results: Results) -> str:
    lines = [
        [row.title, encoder, *(mean_std(values[score.measure], score.digits) for score in results.scores)]
        for row in results.methods.values()
        for encoder, values in row.encoders.items()
        if len(row.encoders) > 1
    ]
    if not lines:
        return ""
    head = ["method", "encoder", *(score.title for score in results.scores)]
    note = "The same policy, fed by the simulator's encoder (source) or the one aligned to the target."
    return f"## Encoders\n\n{table(head, lines, words=2)}\n\n{note}"


def _validity(results: Results) -> str:
    found = results.predictive_validity
    if not found:
        return ""
    lines = [
        [
            simulator,
            str(validity.policies),
            *(
                interval(of.value, of.low, of.high) if of else "-"
                for of in (validity.pearson, validity.spearman)
            ),
        ]
        for simulator, validity in found.items()
    ]
    note = (
        "How well the return in a simulator foretells the return in the target, over policies: every row and "
        "seed, each tested from the task's starts and paid the task's reward. Intervals resample rows, and "
        "seeds within each."
    )
    if "grounded" in found:
        reference = reference_of(results.methods)
        whose = f"{method_title(reference)}'s, of the same seed" if reference else "each row's own"
        note += f" The grounding is {whose}."
    absent = [row.title for row in results.methods.values() if "raw" not in row.simulator_returns]
    if absent:
        note += f" Without {', '.join(absent)}: not tested there, as what sees the full state cannot be."
    head = ["simulator", "policies", "Pearson [95 %]", "Spearman [95 %]"]
    return f"## Predictive validity\n\n{table(head, lines)}\n\n{note}"


def _gap(results: Results) -> str:
    gaps = {method_title(name): gap for name, gap in results.gaps().items()}
    if not gaps:
        return ""
    first = next(iter(gaps.values()))
    parts = []
    for quantity in first.grounded:
        columns = [f"{horizon} step{'s' if horizon > 1 else ''}" for horizon in first.horizons]
        shared = all(gap.raw[quantity] == first.raw[quantity] for gap in gaps.values())
        lines = [["No grounding", *_cells(first.raw[quantity])]] if shared else []
        for title, gap in gaps.items():
            if not shared:
                lines.append([f"{title}, no grounding", *_cells(gap.raw[quantity])])
            lines.append([f"{title}, grounded", *_cells(gap.grounded[quantity])])
        parts.append(table([f"`{quantity}`", *columns], lines))
    note = "Mean error [95 % interval] after so many steps of the target's own actions, averaged over seeds."
    return "## Gap\n\n" + "\n\n".join(parts) + f"\n\n{note}"


def _cells(band: BandMeans) -> list[str]:
    ends = zip(band.mean, band.low, band.high, strict=True)
    return [f"{mean:.3g} [{low:.3g}, {high:.3g}]" for mean, low, high in ends]


def _figure(name: str, figures: Mapping[str, str]) -> str:
    if name not in figures:
        return ""
    return f"## {CAPTIONS[name]}\n\n![{CAPTIONS[name]}]({figures[name]})\n\n{HOW_TO_READ[name]}"
