"""The results of a study as Markdown and as a figure."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from astra_data.reports.figures import walk_prediction
from astra_data.reports.formatting import duration, table
from astra_data.studies.errors import AXES, BODY_AXES
from astra_data.studies.models import MODELS

SHOWN_S = 1.0
"""The horizon of the first table."""

WHAT = """\
**This is a real robot, and it is prediction, not control.** Models learn from recordings of a physical NAO
what its body does under the actions that were sent to it, and then predict recorded walks that they did not
learn from: from each of many moments, given the true past, they are told only the actions that follow. The
truth is the robot's own self-localisation, not motion capture; part of every error is its noise. The actions
came from a policy that saw the robot's position, so they tell a little about it too.

Errors are root mean squares over starting moments and seeds, in brackets with 95 % intervals that resample
pieces of the recordings. *Less than raw* is the share of the raw simulator's error that is gone. Forward and
left are the displacement in the body's frame at the start, x and y the same in the field's. Left out alike
for all models are rows where self-localisation jumps or the robot moves faster than it can walk (it is
carried), and every prediction up to a horizon with such a row before it. Where histories hold such rows, the
simulator's motion stands in. Each prediction is averaged with that of the mirror image, for all alike."""


def render(found: Mapping[str, Any], name: str, command: str, image: str) -> str:
    """Return the page on what `study.run_study` found by `command`, with the figure in file `image`."""
    config = found["config"]
    models = [model for model in config["models"] if model in MODELS]
    sections = [
        f"# {name}: a real NAO's recorded walk, predicted",
        f"```sh\n{command}\n```",
        WHAT,
        _recordings(found),
        "\n".join(f"- **{MODELS[model].title}**: {MODELS[model].text}" for model in models),
        f"A control step is {found['step_s']:.3f} s, H = {config['steps']['history']}. The three networks "
        f"are fitted to open-loop predictions of {config['fit']['steps']} steps (L_state of ASTRA and NAS), "
        "all with noise on the history, mirror images and the same updates.",
        *(f"## {case['title']}\n\n{_case(case)}" for case in found["cases"]),
        f"![errors]({image})\n\n*{found['cases'][0]['title']}. Bands are 95 % intervals.*",
        *([_efficiency(found["cases"][0])] if len(found["cases"][0]["sizes"]) > 1 else []),
        *config["notes"],
        _origin(found),
    ]
    return "\n\n".join(sections) + "\n"


def figure(found: Mapping[str, Any]) -> Figure:
    """Draw the first case: errors by horizon, and by size of the training data."""
    case = found["cases"][0]
    last = case["sizes"][-1]["models"]
    horizons = [f"{horizon:.3g}" for horizon in case["horizons_s"]]
    shown = _shown(case)

    def band(cells: list[Mapping[str, float]]) -> Any:  # noqa: ANN401 - an array
        return np.array([[cell[key] for cell in cells] for key in ("rmse", "low", "high")])

    by_horizon = {
        axis: {model: band([rows[horizon][axis] for horizon in horizons]) for model, rows in last.items()}
        for axis in BODY_AXES
    }
    by_minutes = {
        axis: {model: band([size["models"][model][shown][axis] for size in case["sizes"]]) for model in last}
        for axis in BODY_AXES
    }
    minutes = [size["minutes"] for size in case["sizes"]]
    looks = {name: (model.title, model.colour) for name, model in MODELS.items()}
    return walk_prediction(case["horizons_s"], by_horizon, minutes, by_minutes, float(shown), looks)


def _shown(case: Mapping[str, Any]) -> str:
    """Return the horizon that is nearest to `SHOWN_S`, as the results name it."""
    return f"{min(case['horizons_s'], key=lambda horizon: abs(horizon - SHOWN_S)):.3g}"


def _recordings(found: Mapping[str, Any]) -> str:
    rows = [
        [
            recording["name"],
            f"{recording['minutes']:.1f}",
            str(recording["pieces"]),
            f"{100 * recording['broken_share']:.0f} %",
        ]
        for recording in found["recordings"]
    ]
    return table(["recording", "minutes", "pieces", "rows that are no walking"], rows)


def _case(case: Mapping[str, Any]) -> str:
    size, shown = case["sizes"][-1], _shown(case)
    head = [
        "model",
        "forward (m)",
        "left (m)",
        "turn (rad)",
        "x (m)",
        "y (m)",
        "less than raw",
        "less than ridge",
    ]
    rows = [
        [
            MODELS[model].title,
            *(_error(horizons[shown][axis]) for axis in AXES),
            _share(horizons[shown]["mean"], "less_than_raw"),
            _share(horizons[shown]["mean"], "less_than_ridge"),
        ]
        for model, horizons in size["models"].items()
    ]
    number = case["horizons_s"].index(min(case["horizons_s"], key=lambda horizon: abs(horizon - SHOWN_S)))
    text = (
        f"After {shown} s, learned from {size['minutes']:.1f} minutes, tested on {case['test_minutes']:.1f} "
        f"minutes in {case['pieces']} pieces ({case['starts'][number]} starting moments). The shares are "
        "means over forward, left and turn."
    )
    by_axis = [
        [
            MODELS[model].title,
            *(_share(horizons[shown][axis], "less_than_raw") for axis in BODY_AXES),
            *(_share(horizons[shown][axis], "less_than_ridge") for axis in BODY_AXES),
        ]
        for model, horizons in size["models"].items()
        if model != "raw"
    ]
    per_axis = [
        f"{axis}, less than {reference}"
        for reference in ("raw", "ridge")
        for axis in ("forward", "left", "turn")
    ]
    by_horizon = [
        [
            MODELS[model].title,
            *(" / ".join(f"{horizons[key][axis]['rmse']:.3f}" for axis in BODY_AXES) for key in horizons),
        ]
        for model, horizons in size["models"].items()
    ]
    keys = list(next(iter(size["models"].values())))
    return "\n\n".join(
        [
            text,
            table(head, rows),
            table(["model", *per_axis], by_axis),
            "Forward (m) / left (m) / turn (rad) by horizon:",
            table(["model", *(f"{key} s" for key in keys)], by_horizon),
        ]
    )


def _error(cell: Mapping[str, float]) -> str:
    return f"{cell['rmse']:.3f} [{cell['low']:.3f}, {cell['high']:.3f}]"


def _share(cell: Mapping[str, float], name: str) -> str:
    if name not in cell:
        return "-"
    value, low, high = (100 * cell[key] for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"


def _efficiency(case: Mapping[str, Any]) -> str:
    shown = _shown(case)
    models = [model for model in case["sizes"][-1]["models"] if model != "raw"]
    rows = [
        [
            MODELS[model].title,
            *(_share(size["models"][model][shown]["mean"], "less_than_raw") for size in case["sizes"]),
        ]
        for model in models
    ]
    head = ["model", *(f"{size['minutes']:.3g} min" for size in case["sizes"])]
    return (
        f"## By size of the training data\n\nLess than raw after {shown} s, mean over forward, left and turn "
        f"and over seeds:\n\n{table(head, rows)}"
    )


def _origin(found: Mapping[str, Any]) -> str:
    made, config = found["origin"], found["config"]
    seeds = ", ".join(map(str, config["seeds"]))
    fits = duration(sum(case["fit_cpu_seconds"] for case in found["cases"]))
    spent = f"all fits {fits} of the processor, the last call {duration(made['wall_seconds'])} by the clock"
    return (
        f"Seeds {seeds}; commit {made['git_commit']}; {made['machine']['cpu']}, "
        f"{made['machine']['cores']} cores, torch {made['packages'].get('torch', '?')}; {spent}, "
        "which makes only what is missing."
    )
