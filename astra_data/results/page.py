"""Results → Markdown: tables, figures and how to read them."""

from collections.abc import Mapping

import numpy as np

from astra_data.figures import method_title
from astra_data.results.model import BandMeans, Results
from astra_data.results.wording import (
    by_stage,
    commit,
    duration,
    ends,
    interval,
    line,
    machine,
    spread,
    versions,
)
from astra_data.rows import is_plus

HOW_TO_READ = {
    "success": (
        "Bars are interquartile means over seeds, dots single seeds, lines 95 % bootstrap intervals. A "
        "diamond is the same policy in the simulator that it was trained in: the drop from diamond to bar "
        "is what the transfer costs."
    ),
    "trajectories": (
        "Orange, dashed: the policy in the simulator that it was trained in. Blue: the same policy in the "
        "target. An episode that fails ends with a cross, one that succeeds at the star, its goal. Starts "
        "and goals are drawn apart in the two worlds, so the lines are no pairs: compare the ways that they "
        "take and where they end. The number is the success rate in the target over all episodes and seeds."
    ),
    "mismatch": (
        "The same commands in the ungrounded simulator (orange) and, repeatedly, in the target (blue: "
        "mean; bands: 25 to 75 % and 5 to 95 %). Where they part, the simulator lacks something."
    ),
    "learning": (
        "Share of the training episodes that reach the goal, in the simulator that the policy is trained in: "
        "mean over seeds, band from the worst seed to the best; plus rows have a panel of their own. With "
        "`data_start_share` in the recipe that share of the episodes starts in the midst of a recorded "
        "trajectory, often nearer to the goal, so these figures are no success rates of the task; those are "
        "in the table. High here and low there means that the policy learned what the target does not do."
    ),
    "gap": (
        "The simulator is given the target's actions from a target state on; the error is its distance "
        "from what the target did. Bands are each seed's 95 % interval over episodes, averaged over "
        "seeds. Lower is better; dotted is no grounding."
    ),
}
"""The text under each figure, in the order of the page."""

COLUMNS = (
    "method",
    "success",
    "IQM [95 %]",
    "topple",
    "wall contact",
    "steps",
    "return",
    "success in its simulator",
)

CAPTIONS = {
    "success": "Success in the target",
    "trajectories": "Trajectories",
    "mismatch": "The same commands in simulator and target",
    "learning": "Learning curves",
    "gap": "Open-loop error by horizon",
}


def render(results: Results, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        results: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `HOW_TO_READ`.
    """
    sections = [_head(results), _table(results), _comparison(results), _encoders(results)]
    for name in ("success", "trajectories", "mismatch", "learning"):
        sections.append(_figure(name, figures))
    sections += [_gap(results), _figure("gap", figures), _cost(results), _origin(results)]
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(results: Results) -> str:
    stages = [origin for origin in results.origins if origin.machine and origin.stages != ["report"]]
    machines = " and ".join(dict.fromkeys(machine(origin) for origin in stages))
    seeds = ", ".join(str(seed) for seed in results.seeds)
    return (
        f"# {results.recipe}\n\n"
        f"Task `{results.task}`, seeds {seeds}, {results.episodes} episodes per row and seed. Produced by\n\n"
        f"```\n{results.command}\n```\n\n"
        f"on {machines or 'a machine that was not recorded'}. "
        f"Wall time of the stages, summed: {duration(results.wall_seconds['total'])}."
    )


def _table(results: Results) -> str:
    rows = results.methods
    best = max((row.summary["success"].mean for row in rows.values() if not row.role), default=None)
    lines = [line(COLUMNS), line(["---", *["---:"] * (len(COLUMNS) - 1)])]
    for row in rows.values():
        summary = row.summary
        success = spread(summary["success"], 2)
        lines.append(
            line(
                [
                    f"{row.title} ({row.role})" if row.role else row.title,
                    f"**{success}**" if not row.role and summary["success"].mean == best else success,
                    interval(summary["success"]),
                    spread(summary["topple"], 2),
                    spread(summary["wall_contact"], 2),
                    spread(summary["steps"], 0),
                    spread(summary["return"], 1),
                    spread(summary["simulated_success"], 2) if "simulated_success" in summary else "-",
                ]
            )
        )
    note = (
        "Mean ± standard deviation over seeds, in the target. IQM: interquartile mean over seeds with its "
        "95 % stratified bootstrap interval. Topple: share of episodes in which the robot fell. Wall "
        "contact: share of steps. Floor and ceiling bound the other rows; the best of those is bold."
    )
    if any(map(is_plus, rows)):
        note += " A plus marks the same method trained with the recipe's `[plus]` settings."
    return "## Results\n\n" + "\n".join(lines) + f"\n\n{note}"


def _comparison(results: Results) -> str:
    rows = results.methods
    lines = [
        line([rows[ours].title, rows[other].title, f"{found.probability:.2f}{ends(found.low, found.high)}"])
        for ours, over in results.probability_of_improvement.items()
        for other, found in over.items()
    ]
    if not lines:
        return ""
    head = [line(["row", "beats", "probability [95 %]"]), line(["---", "---", "---:"])]
    note = (
        "How likely a seed of the one has a higher success rate than a seed of the other; ties count half. "
        "Only rows that are trained alike are compared: all with the `[plus]` settings, or all without."
    )
    return "## Probability of improvement\n\n" + "\n".join(head + lines) + f"\n\n{note}"


def _encoders(results: Results) -> str:
    lines = [
        line([row.title, encoder, _mean_std(values["success"])])
        for row in results.methods.values()
        for encoder, values in row.encoders.items()
        if len(row.encoders) > 1 and "success" in values
    ]
    if not lines:
        return ""
    head = [line(["method", "encoder", "success"]), line(["---", "---", "---:"])]
    note = "The same policy, fed by the simulator's encoder (source) or the one aligned to the target."
    return "## Encoders\n\n" + "\n".join(head + lines) + f"\n\n{note}"


def _gap(results: Results) -> str:
    gaps = {method_title(name): gap for name, gap in results.gaps().items()}
    if not gaps:
        return ""
    first = next(iter(gaps.values()))
    parts = []
    for quantity in first.grounded:
        columns = [f"{horizon} step{'s' if horizon > 1 else ''}" for horizon in first.horizons]
        lines = [line([f"`{quantity}`", *columns]), line(["---", *["---:"] * len(columns)])]
        shared = all(gap.raw[quantity] == first.raw[quantity] for gap in gaps.values())
        if shared:
            lines.append(line(["No grounding", *_cells(first.raw[quantity])]))
        for title, gap in gaps.items():
            if not shared:
                lines.append(line([f"{title}, no grounding", *_cells(gap.raw[quantity])]))
            lines.append(line([f"{title}, grounded", *_cells(gap.grounded[quantity])]))
        parts.append("\n".join(lines))
    note = "Mean error [95 % interval] after so many steps of the target's own actions, averaged over seeds."
    return "## Gap\n\n" + "\n\n".join(parts) + f"\n\n{note}"


def _cells(band: BandMeans) -> list[str]:
    ends = zip(band.mean, band.low, band.high, strict=True)
    return [f"{mean:.3g} [{low:.3g}, {high:.3g}]" for mean, low, high in ends]


def _cost(results: Results) -> str:
    lines = [line(["stage", "wall time", "speed"]), line(["---", "---:", "---"])]
    for stage in ("collect", "pair", "ground", "train", "align", "evaluate"):
        speeds = results.throughput.get(stage, {})
        shown = [f"{_rates(rows)} {_unit(figure)}" for figure, rows in speeds.items() if rows]
        seconds = results.wall_seconds.get(stage)
        if shown or seconds is not None:
            time = "-" if seconds is None else duration(seconds)
            lines.append(line([stage, time, "; ".join(shown)]))
    lines.append(line(["total", duration(results.wall_seconds["total"]), ""]))
    note = (
        "Wall time: summed over rows and seeds, which run side by side; a dash where a stage recorded none. "
        "Speed: of one item beside the others, averaged over seeds. Simulator steps/s: the world alone; PPO "
        "steps/s: world and learning."
    )
    return "## Cost\n\n" + "\n".join(lines) + f"\n\n{note}"


def _rates(rows: Mapping[str, list[float]]) -> str:
    means = {method_title(method): float(np.mean(values)) for method, values in rows.items()}
    slowest, fastest = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    if _short(means[slowest]) == _short(means[fastest]):
        return _short(means[slowest])
    return f"{_short(means[slowest])} ({slowest}) to {_short(means[fastest])} ({fastest})"


def _origin(results: Results) -> str:
    lines = [
        f"- Code: {by_stage(results.origins, commit)}.",
        f"- Machine: {by_stage(results.origins, machine)}.",
        f"- Versions: {by_stage(results.origins, versions)}.",
    ]
    hashes_of: dict[tuple[str, str, str], list[str]] = {}
    for dataset in results.datasets:
        key = (dataset.stage, dataset.name, dataset.version)
        hashes_of.setdefault(key, []).append(f"`{dataset.content_hash}` (seed {dataset.seed})")
    for (stage, name, version), contents in hashes_of.items():
        lines.append(f"- Dataset of `{stage}`: {name} {version}, content {', '.join(contents)}.")
    for use in results.evaluated_with:
        rows = ", ".join(results.methods[method].title for method in use.methods)
        numbers = ", ".join(dict.fromkeys(version for version in use.versions if version is not None))
        hashes = ", ".join(dict.fromkeys(f"`{digest}`" for digest in use.hashes if digest is not None))
        named = f"{numbers or 'no dataset'}{f' ({hashes})' if hashes else ''}"
        lines.append(f"- Dataset named by the evaluations of {rows}: {named}.")
    return "## Where this comes from\n\n" + "\n".join(lines)


def _figure(name: str, figures: Mapping[str, str]) -> str:
    if name not in figures:
        return ""
    return f"## {CAPTIONS[name]}\n\n![{CAPTIONS[name]}]({figures[name]})\n\n{HOW_TO_READ[name]}"


def _mean_std(values: list[float]) -> str:
    spread = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{spread}"


def _unit(figure: str) -> str:
    """Return "target steps/s" for "target_steps_per_second"; bare steps are PPO's."""
    steps = figure.removesuffix("_per_second").replace("_", " ")
    return f"{'PPO ' if steps == 'steps' else ''}{steps}/s"


def _short(rate: float) -> str:
    return f"{rate / 1000:.3g} k" if rate >= 1000 else f"{rate:.3g}"
