import json
from pathlib import Path

import numpy as np
import pytest

from astra_data.studies.page import figure, render

RESULTS = Path(__file__).parents[2] / "recipes/results"
FOUND = json.loads((RESULTS / "nao_real.json").read_text())
COMMAND = "uv run astra-data gap recipes/nao_real.toml --data nao_guda"


def test_the_published_page_is_what_its_numbers_give() -> None:
    page = render(FOUND, "nao_real", COMMAND, "nao_real.png")
    assert page == (RESULTS / "nao_real.md").read_text()


def test_without_other_sizes_or_ridge_regression_their_tables_are_empty() -> None:
    (case, *_) = FOUND["cases"]
    size = case["sizes"][-1]
    cells = {
        axis: {key: value for key, value in cell.items() if "ridge" not in key}
        for axis, cell in size["models"]["astra"]["1"].items()
    }
    found = FOUND | {"cases": [case | {"sizes": [size | {"models": {"raw": {"1": cells}}}]}]}
    page = render(found, "toy", "", "")
    assert "By size of the training data" not in page
    assert next(line for line in page.splitlines() if line.startswith("| Raw simulator")).endswith("| - |")


def test_what_is_not_known_is_a_dash() -> None:
    (case, *_) = FOUND["cases"]
    size = case["sizes"][-1]
    cells = {
        axis: {key: None if key.startswith("less") else value for key, value in cell.items()}
        for axis, cell in size["models"]["astra"]["1"].items()
    }
    found = FOUND | {"cases": [case | {"sizes": [size | {"models": {"raw": {"1": cells}}}]}]}
    line = next(line for line in render(found, "toy", "", "").splitlines() if line.startswith("| Raw sim"))
    assert line.endswith("| - | - |")


def test_the_figure_draws_the_numbers_of_the_first_case() -> None:
    case = FOUND["cases"][0]
    drawn = figure(FOUND)
    forward, below = drawn.axes[0], drawn.axes[len(drawn.axes) // 2]
    errors = [case["sizes"][-1]["models"]["raw"][f"{s:.3g}"]["forward_m"]["rmse"] for s in case["horizons_s"]]
    assert np.asarray(forward.lines[0].get_ydata()).tolist() == errors
    by_size = [size["models"]["raw"]["1"]["forward_m"]["rmse"] for size in case["sizes"]]
    assert np.asarray(below.lines[0].get_ydata()).tolist() == by_size
    assert np.asarray(below.lines[0].get_xdata()) == pytest.approx(
        [size["minutes"] for size in case["sizes"]]
    )
