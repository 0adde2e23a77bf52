import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.reports.figures.charts import reliability
from astra_data.reports.held_out import write_held_out
from astra_data.reports.runs import Selection


def write(root: Path, percent: int, seed: int, error: float, **more: Any) -> None:
    """Write errors of NAS: `error` a step ahead, half of that without it; `more` bands replace these."""
    folder = root / f"ground/nas/percent_{percent:03d}/seed_{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    ends = {"mean": 1.0, "low": 0.9, "high": 1.1}
    bands = {
        name: {"x": {key: [scale * end * error * h for h in (1, 10)] for key, end in ends.items()}}
        for name, scale in (("raw", 2), ("grounded", 1))
    }
    for name, changed in more.items():
        bands[name] = {"x": bands.get(name, {"x": {}})["x"] | changed}
    (folder / "gap.json").write_text(json.dumps({"horizons": [1, 10], **bands}))


def page(root: Path, *percents: int, seeds: tuple[int, ...] = (0,), rows: tuple[str, ...] = ("nas",)) -> str:
    path = write_held_out("r", root, Selection(rows, seeds, percents), timestep_s=0.05)
    assert path == root / "gap.md"
    return path.read_text()


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ((0.3, 0.109, 0.1), "from 50 % on, the error is within the interval of 100 %."),
        ((0.3, 0.12, 0.1), "the error still decreases up to 100 %: more data may help."),
        # A small size that is good by chance is not enough while a larger one is worse.
        ((0.1, 0.2, 0.1), "the error still decreases up to 100 %: more data may help."),
    ],
)
def test_enough_is_where_more_makes_no_difference(tmp_path: Path, errors: tuple[float, ...], expected: str) -> None:
    for percent, error in zip((25, 50, 100), errors, strict=True):
        for seed, factor in ((0, 0.5), (1, 1.5)):
            write(tmp_path, percent, seed, error * factor)
    text = page(tmp_path, 100, 25, 50, seeds=(0, 1, 2))
    assert f"- NAS, `x`, 10 steps ahead: {expected}\n" in text
    assert "| size | simulator | 1 step (0.05 s) | 10 steps (0.5 s) |\n" in text
    assert f"| 25 % | NAS, grounded | {errors[0]:.3g} [{0.9 * errors[0]:.3g}, {1.1 * errors[0]:.3g}] |" in text
    assert "averaged over seeds 0, 1." in text


def test_a_single_held_out_episode_settles_nothing(tmp_path: Path) -> None:
    for percent in (50, 100):
        for seed in (0, 1):
            write(tmp_path, percent, seed, 0.1)
    write(tmp_path, 100, 1, 0.1, grounded={"low": [0.09, None], "high": [0.11, None]})
    text = page(tmp_path, 50, 100, seeds=(0, 1))
    unknown = "unknown: at 100 %, a seed has only one held-out episode of that length."
    assert f"- NAS, `x`, 10 steps ahead: {unknown}\n" in text
    assert "\n| 100 % | NAS, grounded | 0.1 [0.09, 0.11] | 1 |" in text


def test_a_correction_that_makes_the_simulator_worse_is_named(tmp_path: Path) -> None:
    write(tmp_path, 50, 0, 0.1)
    write(tmp_path, 100, 0, 0.2)
    warning = "**Here the correction makes the simulator worse.**"
    assert warning not in page(tmp_path, 50, 100)
    write(tmp_path, 50, 0, 0.1, grounded={"mean": [0.1, 9.0], "low": [0.09, 8.0]})
    write(tmp_path, 100, 0, 0.2, grounded={"mean": [0.2, 4.5], "low": [0.18, 4.3]})
    assert warning not in page(tmp_path, 50, 100)  # without a correction it is up to 4.4
    for low in (4.41, None):  # or without an interval
        write(tmp_path, 100, 0, 0.2, grounded={"mean": [0.2, 4.5], "low": [0.18, low]})
        # By the most data: there it is 0.2 after a step, as half of what it is without, and 4 without after ten.
        text = page(tmp_path, 50, 100)
        assert warning in text and "- `x`, NAS: 10 steps ahead (4.5, without 4)\n" in text
    far = {key: [1, 4501] for key in ("mean", "low", "high")}  # of what moves by thousands, both predict all
    write(tmp_path, 100, 0, 0.2, grounded={"mean": [0.2, 4.5], "low": [0.18, None]}, still=far)
    assert warning not in page(tmp_path, 50, 100)


@pytest.mark.parametrize(
    ("still", "percent", "is_named"), [(1.0, 100, True), (2.0, 100, True), (2.1, 100, False), (1.0, 25, False)]
)
def test_a_simulator_no_better_than_the_persistence_baseline_is_named(
    tmp_path: Path, still: float, percent: int, is_named: bool
) -> None:
    """Judged ten steps ahead, by the largest size: there the raw simulator is off by 2."""
    for size in (25, 100):
        of = still if size == percent else 3.0
        write(tmp_path, size, 0, 0.1, still={end: [0.1, of] for end in ("mean", "low", "high")})
    text = page(tmp_path, 25, 100)
    line = f"| {percent} % | No motion (persistence baseline) | 0.1 [0.1, 0.1] | {still:.3g} [{still:.3g}, "
    assert line in text and ("**In `x`, the simulator without grounding is no better" in text) == is_named


def test_rows_may_have_other_sizes(tmp_path: Path) -> None:
    for percent in (25, 100):
        write(tmp_path, percent, 0, 0.1)
    file = tmp_path / "ground/nas/percent_025/seed_0/gap.json"
    file.write_text(file.read_text().replace("[1, 10]", "[1, 5]", 1))
    (tmp_path / "ground/astra").mkdir()
    (tmp_path / "ground/nas/percent_100").rename(tmp_path / "ground/astra/percent_100")
    text = page(tmp_path, 25, 100, rows=("nas", "astra"))
    assert "| size | simulator | 1 step (0.05 s) |\n" in text  # what all have
    rows = [line.split(" | ")[:2] for line in text.splitlines() if "%" in line and "|" in line]
    sizes = {"| 25 %": "NAS, grounded", "| 100 %": "ASTRA, grounded"}
    assert rows == [[size, shown] for size, row in sizes.items() for shown in ("No grounding", row)]
    write(tmp_path, 100, 0, 0.3)  # of another simulator
    text = page(tmp_path, 100, rows=("nas", "astra"))
    assert "| NAS, no grounding | 0.6 [" in text and "| ASTRA, no grounding | 0.2 [" in text


def test_nothing_finished_is_no_page_and_a_malformed_file_one_line(tmp_path: Path) -> None:
    assert write_held_out("r", tmp_path, Selection(("nas",), (0,), (25,)), timestep_s=0.1) is None
    write(tmp_path, 25, 0, 0.1)
    (tmp_path / "ground/nas/percent_025/seed_0/gap.json").write_text("{}")
    with pytest.raises(BadInputError, match="is not what its stage writes"):
        page(tmp_path, 25)


def test_how_well_rewards_and_states_are_predicted_stands_on_the_page(tmp_path: Path) -> None:
    write(tmp_path, 100, 0, 0.1)
    epochs = [{"r2_state": 0.1, "r2_reward": 0.9}, {"r2_state": 0.97, "r2_reward": -2.7}]
    (tmp_path / "ground/nas/percent_100/seed_0/metrics.json").write_text(json.dumps({"epochs": epochs}))
    text = page(tmp_path, 100)
    assert "| grounding | state | reward of steps that go on |\n" in text and "| NAS | 0.97 | -2.70 |" in text


def write_failures(root: Path, seed: int, auc: float, last: float | None = None) -> None:
    reliability = [[0.01, 0.01, 900], [0.2, 0.1 * auc, 60], [0.6, 0.5 * auc, 20]]
    windows = {"1-20": auc, "11-30": auc - 0.1, "21-40": last}
    of = {"failures": 3, "auc": windows, "brier_skill": auc - 0.7, "reliability": reliability}
    none = {"failures": 0, "auc": None, "brier_skill": None, "reliability": None}
    file = root / f"ground/nas/percent_100/seed_{seed}/metrics.json"
    file.write_text(json.dumps({"failures": {"failure_model": of, "topple_head": none}}))


def test_how_well_failures_are_predicted_is_shown_where_it_was_measured(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        write(tmp_path, 100, seed, 0.1)
    text = page(tmp_path, 100, seeds=(0, 1, 2, 3))
    assert "Failures, predicted" not in text and ".png" not in text
    assert not (tmp_path / "gap_reliability.png").exists()
    write_failures(tmp_path, 0, 0.8, last=0.65)
    write_failures(tmp_path, 1, 0.9)  # with episodes too short for the last window
    text = page(tmp_path, 100, seeds=(0, 1, 2, 3))
    lines = [line for line in text.splitlines() if "failure model" in line or "topple head" in line]
    assert "](gap_reliability.png)" in text and (tmp_path / "gap_reliability.png").read_bytes().startswith(b"\x89PNG")
    # Above 0.1, each seed has 60 steps at 0.2 and 20 at 0.6: 0.3 in the mean; 0.085 and 0.425 of them fail.
    assert lines == ["| NAS: failure model | 6 | 0.85 | 0.75 | 0.65 | 0.15 | 0.17 of 0.30 |"]


def test_the_figure_pools_the_steps_of_all_seeds_by_bin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the whole dataset; a predicted rate of 0.3 is in the bin of 0.2, with twice as many steps."""
    shown = Mock(wraps=reliability)
    monkeypatch.setattr("astra_data.reports.figures.charts.reliability", shown)
    for percent, seed in ((100, 0), (100, 1), (25, 0)):
        write(tmp_path, percent, seed, 0.1)
    write_failures(tmp_path, 0, 1.0)
    windows = {"1-20": 0.5, "11-30": None, "21-40": None}
    of = {"failures": 1, "auc": windows, "brier_skill": 0.0, "reliability": [[0.3, 0.7, 120]]}
    file = tmp_path / "ground/nas/percent_100/seed_1/metrics.json"
    file.write_text(json.dumps({"failures": {"failure_model": of}}))
    page(tmp_path, 25, 100, seeds=(0, 1))
    (parts,) = shown.call_args.args
    assert [*parts] == ["failure model"] and [*parts["failure model"]] == ["nas"]
    predicted, observed, steps = parts["failure model"]["nas"]
    np.testing.assert_allclose(predicted, [0.01, (60 * 0.2 + 120 * 0.3) / 180, 0.6])
    np.testing.assert_allclose(observed, [0.01, (60 * 0.1 + 120 * 0.7) / 180, 0.5])
    assert steps.tolist() == [900.0, 180.0, 20.0]
