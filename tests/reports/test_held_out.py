import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.reports.figures.errors import reliability
from astra_data.reports.held_out import write_held_out

Rates = Mapping[str, Mapping[str, NDArray[np.float64]]]


def write(root: Path, percent: int, seed: int, error: float) -> None:
    folder = root / f"ground/nas/percent_{percent:03d}/seed_{seed}"
    folder.mkdir(parents=True)
    ends = {"mean": 1.0, "low": 0.9, "high": 1.1}
    bands = {
        name: {"x": {key: [scale * end * error * h for h in (1, 10)] for key, end in ends.items()}}
        for name, scale in (("raw", 2), ("grounded", 1))
    }
    (folder / "gap.json").write_text(json.dumps({"horizons": [1, 10], **bands}))


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ((0.3, 0.109, 0.1), "from 50 % on, the error is within the interval of 100 %."),
        ((0.3, 0.2, 0.1), "the error still decreases up to 100 %: more data may help."),
        # A small size that is good by chance is not enough while a larger one is worse.
        ((0.1, 0.2, 0.1), "the error still decreases up to 100 %: more data may help."),
    ],
)
def test_enough_is_where_more_makes_no_difference(
    tmp_path: Path, errors: tuple[float, ...], expected: str
) -> None:
    for percent, error in zip((25, 50, 100), errors, strict=True):
        for seed, factor in ((0, 0.5), (1, 1.5)):
            write(tmp_path, percent, seed, error * factor)
    page = write_held_out("r", tmp_path, ("nas",), (0, 1, 2), (100, 25, 50), timestep_s=0.05)
    assert page == tmp_path / "gap.md"
    lines = page.read_text().splitlines()
    assert f"- NAS, `x`, 10 steps ahead: {expected}" in lines
    assert "| size | simulator | 1 step (0.05 s) | 10 steps (0.5 s) |" in lines
    first = " | ".join(
        ["| 25 %", "NAS, grounded", f"{errors[0]:.3g} [{0.9 * errors[0]:.3g}, {1.1 * errors[0]:.3g}]"]
    )
    assert any(line.startswith(first) for line in lines)
    assert "averaged over seeds 0, 1." in page.read_text()


def test_a_single_held_out_episode_settles_nothing(tmp_path: Path) -> None:
    for percent in (50, 100):
        for seed in (0, 1):
            write(tmp_path, percent, seed, 0.1)
    file = tmp_path / "ground/nas/percent_100/seed_1/gap.json"
    gap = json.loads(file.read_text())
    gap["grounded"]["x"] |= {end: [gap["grounded"]["x"][end][0], None] for end in ("low", "high")}
    file.write_text(json.dumps(gap))
    page = write_held_out("r", tmp_path, ("nas",), (0, 1), (50, 100), timestep_s=0.05)
    assert page is not None
    lines = page.read_text().splitlines()
    told = "unknown: at 100 %, a seed has only one held-out episode of that length."
    assert f"- NAS, `x`, 10 steps ahead: {told}" in lines
    assert any(line.startswith("| 100 % | NAS, grounded | 0.1 [0.09, 0.11] | 1 |") for line in lines)


def test_a_correction_that_makes_the_simulator_worse_is_told(tmp_path: Path) -> None:
    for percent, error in ((50, 0.1), (100, 0.2)):
        write(tmp_path, percent, 0, error)
    told = "**Here the correction makes the simulator worse.**"
    page = write_held_out("r", tmp_path, ("nas",), (0,), (50, 100), timestep_s=0.05)
    assert page is not None and told not in page.read_text()
    for percent, after_ten in ((50, 9.0), (100, 4.5)):
        file = tmp_path / f"ground/nas/percent_{percent:03d}/seed_0/gap.json"
        gap = json.loads(file.read_text())
        gap["grounded"]["x"]["mean"][1] = after_ten
        file.write_text(json.dumps(gap))
    write_held_out("r", tmp_path, ("nas",), (0,), (50, 100), timestep_s=0.05)
    # By the most data: there it is 0.2 after a step, as half of what it is without, and 4 without after ten.
    lines = page.read_text().splitlines()
    assert told in page.read_text() and "- `x`, NAS: 10 steps ahead (4.5, without 4)" in lines


@pytest.mark.parametrize(("still", "is_astray"), [(1.0, True), (2.0, True), (2.1, False)])
def test_a_simulator_that_is_no_better_than_standing_still_is_told(
    tmp_path: Path, still: float, is_astray: bool
) -> None:
    write(tmp_path, 100, 0, 0.1)  # the raw simulator is off by 0.2 after a step, and by 2 after ten
    file = tmp_path / "ground/nas/percent_100/seed_0/gap.json"
    bands = {"x": {end: [0.1, still] for end in ("mean", "low", "high")}}
    file.write_text(json.dumps(json.loads(file.read_text()) | {"still": bands}))
    page = write_held_out("r", tmp_path, ("nas",), (0,), (100,), timestep_s=0.05)
    assert page is not None
    line = f"| No motion (persistence baseline) | 0.1 [0.1, 0.1] | {still:.3g} [{still:.3g}, {still:.3g}] |"
    assert line in page.read_text()
    assert ("**In `x`, the simulator without grounding is no better" in page.read_text()) == is_astray


@pytest.mark.parametrize(("percent", "is_told"), [(25, False), (100, True)])
def test_a_simulator_is_judged_by_the_largest_size(tmp_path: Path, percent: int, is_told: bool) -> None:
    for size in (25, 100):
        write(tmp_path, size, 0, 0.1)
        file = tmp_path / f"ground/nas/percent_{size:03d}/seed_0/gap.json"
        bands = {"x": {end: [0.1, 1.0 if size == percent else 3.0] for end in ("mean", "low", "high")}}
        file.write_text(json.dumps(json.loads(file.read_text()) | {"still": bands}))
    page = write_held_out("r", tmp_path, ("nas",), (0,), (25, 100), timestep_s=0.05)
    assert page is not None
    assert ("the simulator without grounding is no better" in page.read_text()) == is_told


def test_rows_may_have_other_sizes(tmp_path: Path) -> None:
    for percent in (25, 100):
        write(tmp_path, percent, 0, 0.1)
    (tmp_path / "ground/nas/percent_100").rename(tmp_path / "astra")
    (tmp_path / "ground/astra").mkdir()
    (tmp_path / "astra").rename(tmp_path / "ground/astra/percent_100")
    page = write_held_out("r", tmp_path, ("nas", "astra"), (0,), (25, 100), timestep_s=0.05)
    assert page is not None
    rows = [line.split(" | ")[:2] for line in page.read_text().splitlines() if "%" in line and "|" in line]
    assert rows == [
        *(["| 25 %", "No grounding"], ["| 25 %", "NAS, grounded"]),
        *(["| 100 %", "No grounding"], ["| 100 %", "ASTRA, grounded"]),
    ]


def test_nothing_finished_is_no_page_and_a_malformed_file_one_line(tmp_path: Path) -> None:
    assert write_held_out("r", tmp_path, ("nas",), (0,), (25,), timestep_s=0.1) is None
    write(tmp_path, 25, 0, 0.1)
    (tmp_path / "ground/nas/percent_025/seed_0/gap.json").write_text("{}")
    with pytest.raises(BadInputError, match="is not what its stage writes"):
        write_held_out("r", tmp_path, ("nas",), (0,), (25,), timestep_s=0.1)


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
    given = ("r", tmp_path, ("nas",), (0, 1, 2, 3), (100,))
    page = write_held_out(*given, timestep_s=0.05)
    assert page is not None and "Failures, predicted" not in page.read_text()
    assert not (tmp_path / "gap_reliability.png").exists() and ".png" not in page.read_text()
    write_failures(tmp_path, 0, 0.8, last=0.65)
    write_failures(tmp_path, 1, 0.9)  # with episodes too short for the last window
    write_held_out(*given, timestep_s=0.05)
    lines = [
        line for line in page.read_text().splitlines() if "failure model" in line or "topple head" in line
    ]
    assert "](gap_reliability.png)" in page.read_text()
    assert (tmp_path / "gap_reliability.png").read_bytes().startswith(b"\x89PNG")
    # Above 0.1, each seed has 60 steps at 0.2 and 20 at 0.6: 0.3 in the mean; 0.085 and 0.425 of them fail.
    assert lines == ["| NAS: failure model | 6 | 0.85 | 0.75 | 0.65 | 0.15 | 0.17 of 0.30 |"]


def test_the_figure_pools_the_steps_of_all_seeds_by_bin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the whole dataset; a predicted rate of 0.3 is in the bin of 0.2, with twice as many steps."""
    shown: list[Rates] = []

    def noted(parts: Rates) -> Figure:
        shown.append(parts)
        return reliability(parts)

    monkeypatch.setattr("astra_data.reports.figures.errors.reliability", noted)
    for percent, seed in ((100, 0), (100, 1), (25, 0)):
        write(tmp_path, percent, seed, 0.1)
    write_failures(tmp_path, 0, 1.0)
    windows = {"1-20": 0.5, "11-30": None, "21-40": None}
    of = {"failures": 1, "auc": windows, "brier_skill": 0.0, "reliability": [[0.3, 0.7, 120]]}
    file = tmp_path / "ground/nas/percent_100/seed_1/metrics.json"
    file.write_text(json.dumps({"failures": {"failure_model": of}}))
    write_held_out("r", tmp_path, ("nas",), (0, 1), (25, 100), timestep_s=0.05)
    (parts,) = shown
    assert [*parts] == ["failure model"] and [*parts["failure model"]] == ["nas"]
    predicted, observed, steps = parts["failure model"]["nas"]
    np.testing.assert_allclose(predicted, [0.01, (60 * 0.2 + 120 * 0.3) / 180, 0.6])
    np.testing.assert_allclose(observed, [0.01, (60 * 0.1 + 120 * 0.7) / 180, 0.5])
    assert steps.tolist() == [900.0, 180.0, 20.0]


def test_enough_is_judged_at_ten_steps_though_errors_are_known_further_ahead(tmp_path: Path) -> None:
    for percent, ten in ((50, 0.4), (100, 0.2)):
        write(tmp_path, percent, 0, 0.1)
        file = tmp_path / f"ground/nas/percent_{percent:03d}/seed_0/gap.json"
        bands = {
            end: [0.1 * of, ten * of, 0.8 * of] for end, of in (("mean", 1), ("low", 0.9), ("high", 1.1))
        }
        file.write_text(json.dumps({"horizons": [1, 10, 50], "grounded": {"x": bands}, "raw": {"x": bands}}))
    page = write_held_out("r", tmp_path, ("nas",), (0,), (50, 100), timestep_s=0.05)
    assert page is not None
    found = "NAS, `x`, 10 steps ahead: the error still decreases up to 100 %: more data may help."
    assert f"- {found}" in page.read_text()
