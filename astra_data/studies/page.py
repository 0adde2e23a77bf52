"""The results of a study as Markdown (its text is in `reports/templates`) and as a figure."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from astra_data.reports.figures.walks import walk_prediction
from astra_data.reports.formatting import fill
from astra_data.studies.joints import ALL
from astra_data.studies.models import MODELS, MODELS_OF_JOINTS, Model
from astra_data.studies.walking import AXES, BODY_AXES

SHOWN_S = 1.0
"""The horizon of the first table."""


def render(found: Mapping[str, Any], name: str, command: str, image: str) -> str:
    """Return the page on what `study.run_study` found by `command`, with the figure in file `image`."""
    first = found["cases"][0]
    last = first["sizes"][-1]["models"]
    looks, of_joints = _looks(found), _is_of_joints(found)
    recordings = [
        [
            recording["name"],
            f"{recording['minutes']:.3g}" if of_joints else f"{recording['minutes']:.1f}",
            str(recording["pieces"]),
            *([] if of_joints else [f"{100 * recording['broken_share']:.0f} %"]),
        ]
        for recording in found["recordings"]
    ]
    by_minutes = [
        [
            looks[model].title,
            *(
                _share(size["models"][model][_shown(first)]["mean"], "less_than_raw")
                for size in first["sizes"]
            ),
        ]
        for model in last
        if model != "raw"
    ]
    return fill(
        "joints.md.jinja" if of_joints else "walks.md.jinja",
        found=found,
        config=found["config"],
        name=name,
        command=command,
        image=image,
        recordings=recordings,
        models=[
            (looks[model].title, looks[model].text) for model in found["config"]["models"] if model in looks
        ],
        cases=[_case_of_joints(case, looks) if of_joints else _case(case, looks) for case in found["cases"]],
        has_targets=found.get("has_targets", True),
        minutes=["model", *(f"{size['minutes']:.3g} min" for size in first["sizes"])],
        by_minutes=by_minutes if len(first["sizes"]) > 1 else [],
        made=found["origin"],
        fits=sum(case["fit_cpu_seconds"] for case in found["cases"]),
    )


def figure(found: Mapping[str, Any]) -> Figure:
    """Draw the first case: errors by horizon, and by size of the training data."""
    case = found["cases"][0]
    last = case["sizes"][-1]["models"]
    horizons = [f"{horizon:.3g}" for horizon in case["horizons_s"]]
    shown = _shown(case)

    def band(cells: list[Mapping[str, float]]) -> Any:  # noqa: ANN401 - an array
        return np.array([[cell[key] for cell in cells] for key in ("rmse", "low", "high")])

    axes = case.get("judged", BODY_AXES)
    by_horizon = {
        axis: {model: band([rows[horizon][axis] for horizon in horizons]) for model, rows in last.items()}
        for axis in axes
    }
    by_minutes = {
        axis: {model: band([size["models"][model][shown][axis] for size in case["sizes"]]) for model in last}
        for axis in axes
    }
    minutes = [size["minutes"] for size in case["sizes"]]
    looks = {name: (model.title, model.color) for name, model in _looks(found).items()}
    return walk_prediction(case["horizons_s"], by_horizon, minutes, by_minutes, float(shown), looks)


def _is_of_joints(found: Mapping[str, Any]) -> bool:
    return bool(found["config"].get("simulator") == "joints")


def _looks(found: Mapping[str, Any]) -> Mapping[str, Model]:
    return MODELS_OF_JOINTS if _is_of_joints(found) else MODELS


def _shown_s(case: Mapping[str, Any]) -> float:
    """Return the horizon that is nearest to `SHOWN_S`."""
    return float(min(case["horizons_s"], key=lambda horizon: abs(horizon - SHOWN_S)))


def _shown(case: Mapping[str, Any]) -> str:
    """Return that horizon as the key of the results."""
    return f"{_shown_s(case):.3g}"


def _numbers(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers of a case on the page."""
    size = case["sizes"][-1]
    return {
        "title": case["title"],
        "shown": _shown(case),
        "minutes": size["minutes"],
        "test_minutes": case["test_minutes"],
        "pieces": case["pieces"],
        "starts": case["starts"][case["horizons_s"].index(_shown_s(case))],
        "horizons": ["model", *(f"{horizon} s" for horizon in size["models"]["raw"])],
    }


def _case_of_joints(case: Mapping[str, Any], looks: Mapping[str, Model]) -> dict[str, Any]:
    """Return the numbers of a case, and the lines of its three tables."""
    models, shown = case["sizes"][-1]["models"], _shown(case)
    at_shown = {model: horizons[shown] for model, horizons in models.items()}
    return _numbers(case) | {
        "errors": [
            [
                looks[model].title,
                _error(cells[ALL]),
                *(_share(cells[ALL], f"less_than_{reference}") for reference in ("raw", "ridge")),
            ]
            for model, cells in at_shown.items()
        ],
        "joints": ["joint", *(looks[model].title for model in models)],
        "by_joint": [
            [joint, *(f"{cells[joint]['rmse']:.4f}" for cells in at_shown.values())]
            for joint in case["axes"][1:]
        ],
        "by_horizon": [
            [looks[model].title, *(f"{cells[ALL]['rmse']:.4f}" for cells in horizons.values())]
            for model, horizons in models.items()
        ],
    }


def _case(case: Mapping[str, Any], looks: Mapping[str, Model]) -> dict[str, Any]:
    """Return the numbers of a case of walks, and the lines of its three tables."""
    size, shown = case["sizes"][-1], _shown(case)
    at_shown = {model: horizons[shown] for model, horizons in size["models"].items()}
    return _numbers(case) | {
        "errors": [
            [
                looks[model].title,
                *(_error(cells[axis]) for axis in AXES),
                *(_share(cells["mean"], f"less_than_{reference}") for reference in ("raw", "ridge")),
            ]
            for model, cells in at_shown.items()
        ],
        "by_axis": [
            [
                looks[model].title,
                *(
                    _share(cells[axis], f"less_than_{reference}")
                    for reference in ("raw", "ridge")
                    for axis in BODY_AXES
                ),
            ]
            for model, cells in at_shown.items()
            if model != "raw"
        ],
        "by_horizon": [
            [
                looks[model].title,
                *(
                    " / ".join(f"{cells[axis]['rmse']:.3f}" for axis in BODY_AXES)
                    for cells in horizons.values()
                ),
            ]
            for model, horizons in size["models"].items()
        ],
    }


def _error(cell: Mapping[str, float]) -> str:
    return f"{cell['rmse']:.3f} [{cell['low']:.3f}, {cell['high']:.3f}]"


def _share(cell: Mapping[str, Any], name: str) -> str:
    if cell.get(name) is None:
        return "-"
    value, low, high = (100 * cell[key] for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"
