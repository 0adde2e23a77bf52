import re
from pathlib import Path

import numpy as np
import pytest
from toy_logs import Columns, write_logs

from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset.checkup import jumps as module
from astra_data.dataset.checkup.checkup import check_up
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.checkup.jumps import Jumps, jumps
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Array, Column, Episode


def steps(*large: float, usual: float = 0.1) -> Array:
    """Ten usual steps, those given, ten usual ones."""
    return np.array([usual] * 10 + list(large) + [usual] * 10)


@pytest.mark.parametrize(
    ("large", "found"),
    [
        ([5.0], [10]),
        ([2.0], []),  # not above the limit
        ([2.01], [10]),
        ([5.0, 5.0], [10]),  # there and back
        ([5.0, 5.0, 5.0], []),  # a robot that moves
        ([0.49, 5.0], [11]),
        ([0.51, 5.0], []),  # a neighbor has a tenth of it
        ([5.0, 0.51], []),
        ([5.0, 0.1, 0.51], []),
        ([5.0, 0.1, 0.1, 0.51], []),
        ([5.0, 0.1, 0.1, 0.1, 0.51], [10]),  # four steps away
        ([5.0] + [0.1] * 6 + [6.0], [10, 17]),
        ([5.0] + [0.1] * 2 + [6.0], []),
    ],
)
def test_a_jump_is_far_above_its_neighbors(large: list[float], found: list[int]) -> None:
    assert list(jumps(steps(*large), 2.0)) == found


@pytest.mark.parametrize(("before", "found"), [(2, []), (3, [3])])
def test_a_jump_has_three_neighbors(before: int, found: list[int]) -> None:
    assert list(jumps(np.array([0.1] * before + [5.0]), 2.0)) == found


def column(unit: str = "", role: str = "") -> Column:
    astra = {key: [word] for key, word in (("unit", unit), ("role", role)) if word}
    return Column(STATE, astra=astra or None)


def limits(values: Array, spec: Column) -> float:
    found = Jumps(spec, len(values))
    found.add(Episode(0, {STATE: values.astype(np.float32)}))
    return float(found.limits()[0])


WALK = np.cumsum(np.full(1000, 0.5))


def test_a_large_step_is_twenty_median_ones_of_those_that_move() -> None:
    assert limits(WALK, column()) == pytest.approx(10.0)
    assert limits(WALK.repeat(5), column()) == pytest.approx(10.0)
    assert limits(np.zeros(100), column()) == np.inf


@pytest.mark.parametrize(
    ("unit", "role", "told"),
    [
        ("m", "", True),
        ("", "invariant", True),
        ("m/s", "", False),
        ("rad/s", "", False),
        ("s", "", False),
        ("1", "", True),
        ("deg", "", True),
        ("", "vector", False),
    ],
)
def test_only_places_and_angles_jump(unit: str, role: str, told: bool) -> None:
    if role == "vector":
        spec = Column(STATE, size=2, astra={"role": ["vector"] * 2})
        values = np.column_stack([WALK, WALK])
    else:
        spec, values = column(unit, role), WALK
    assert np.isfinite(limits(values, spec)) == told


@pytest.mark.parametrize(("share", "told"), [(0.019, True), (0.021, False)])
def test_a_value_that_moves_in_jerks_does_not_jump(share: float, told: bool) -> None:
    moved = np.full(10_000, 0.5)
    moved[: round(share * 10_000)] = 50.0
    assert np.isfinite(limits(np.concatenate([[0], np.cumsum(moved)]), column())) == told


@pytest.mark.parametrize(
    ("spec", "turn"),
    [(column("rad"), 2 * np.pi), (column("deg"), 360.0), (column(role="heading"), 2 * np.pi)],
)
def test_an_angle_that_wraps_does_not_jump(spec: Column, turn: float) -> None:
    values = (np.arange(500) * turn / 64) % turn
    found = Jumps(spec, 499)
    np.testing.assert_allclose(found.steps({STATE: values}), turn / 64)
    np.testing.assert_allclose(Jumps(column("m"), 499).steps({STATE: values}).max(), turn * 63 / 64)


def test_a_quaternion_of_the_other_sign_is_the_same_rotation() -> None:
    spec = Column(STATE, size=4, astra={"role": ["quaternion"] * 4})
    angles = np.linspace(0, 3, 50)
    values = np.column_stack([np.cos(angles / 2), np.zeros(50), np.zeros(50), np.sin(angles / 2)])
    flipped = values.copy()
    flipped[25:] *= -1
    found = Jumps(spec, 49)
    np.testing.assert_allclose(found.steps({STATE: flipped}), found.steps({STATE: values}))


def test_next_states_give_the_last_step_too() -> None:
    values = np.array([0.0, 1.0, 3.0])
    found = Jumps(column(), 3)
    assert found.steps({STATE: values})[:, 0].tolist() == [1, 2]
    assert found.steps({STATE: values, NEXT_STATE: np.array([1.0, 3.0, 7.0])})[:, 0].tolist() == [1, 2, 4]


def test_of_many_steps_every_other_is_a_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAMPLES", 10)
    found = Jumps(column(), 25)
    values = np.arange(25.0) ** 2
    for first, last in ((0, 4), (4, 12), (12, 25)):
        part = {STATE: values[first:last], NEXT_STATE: (np.arange(first, last) + 1.0) ** 2}
        found.add(Episode(0, {name: each.astype(np.float32) for name, each in part.items()}))
    sampled = np.concatenate(found._samples)[:, 0]
    assert sampled.tolist() == [2 * index + 1 for index in range(0, 25, 3)]


def test_jumps_are_found_in_the_episodes_that_have_them(tmp_path: Path) -> None:
    def carried(uid: int, columns: Columns) -> None:
        for at, far in {3: [(20, 1.0), (60, 2.0)], 8: [(50, 0.7)]}.get(uid, []):
            columns[STATE][at:, 1] += far
            columns[NEXT_STATE][at - 1 :, 1] += far

    finding = only_finding(write_logs(tmp_path / "logs", carried))
    assert finding.episodes == (3, 8)
    assert finding.what.startswith("3 single-step jumps in y of observation.state; the largest is 1.98 in y")
    assert 'column = "observation.state", values = [1], above = 0.6' in finding.advice


def only_finding(dataset: Dataset) -> Finding:
    (spec,) = dataset.specs([STATE])
    found = Jumps(spec, int(dataset.lengths.sum()))
    for episode in dataset.episodes([STATE, NEXT_STATE]):
        found.add(episode)
    (finding,) = found.findings(dataset, "walks")
    return finding


def test_the_threshold_it_names_is_below_the_largest_jump(tmp_path: Path) -> None:
    def carried(uid: int, columns: Columns) -> None:
        for at in (20, 60):
            columns[STATE][at:, 1] += 6.23
            columns[NEXT_STATE][at - 1 :, 1] += 6.23

    finding = only_finding(write_logs(tmp_path / "logs", carried))
    above, largest = (
        re.search(f"{before} ([0-9.]+)", text)
        for before, text in (("above =", finding.advice), ("the largest is", finding.what))
    )
    assert above and largest and float(above[1]) < float(largest[1])


def turning(root: Path, name: str, turn: float, unit: str = "") -> Dataset:
    """Write three robots that turn around once and a half; the second is carried away, too."""
    astra = {"unit": ["", unit]} if unit else None
    columns = [Column(STATE, size=2, names=("x", name), astra=astra), Column(ACTION)]
    with DatasetWriter(
        root, columns, fps=10, task="turn", description={"name": "turns", "stage": "import"}
    ) as writer:
        for uid in range(3):
            rng = np.random.default_rng(uid)
            angle = turn * (0.1 * uid + 1.5 * np.linspace(0, 1, 300)) % turn
            x = np.cumsum(rng.uniform(0.05, 0.1, 300)) + 5.0 * ((np.arange(300) > 50) & (uid == 1))
            state = np.column_stack([x, angle]).astype(np.float32)
            writer.add(Episode(uid, {STATE: state, ACTION: rng.normal(size=300).astype(np.float32)}))
    return Dataset.open(root)


@pytest.mark.parametrize(
    ("name", "turn", "unit"), [("theta", 2 * np.pi, "rad"), ("base.yaw.pos", 360.0, "deg")]
)
def test_an_angle_without_a_unit_that_wraps_is_told_as_one(
    tmp_path: Path, name: str, turn: float, unit: str
) -> None:
    """Nothing is to be deleted; what jumps is told as before."""
    dataset = turning(tmp_path / "turns", name, turn)
    found = [f for f in check_up(dataset, "turns").findings if "jump" in f.what]
    wraps, jump = found
    assert wraps.what == f"{name} of observation.state jumps by a full turn, like an angle that wraps"
    assert wraps.episodes == (0, 1, 2) and wraps.severity == "warning"
    assert "cosine and sine" in wraps.advice and f'unit = "{unit}"' in wraps.advice
    assert "delete" not in wraps.advice and "split" not in wraps.advice
    assert jump.what.startswith("1 single-step jump in x of observation.state") and jump.episodes == (1,)
    dataset = turning(tmp_path / "told", name, turn, unit)
    assert ["single-step" in f.what for f in check_up(dataset).findings if "jump" in f.what] == [True]


@pytest.mark.parametrize(("name", "turn"), [("y", 2 * np.pi), ("theta", 5.8)])
def test_another_value_that_jumps_by_a_turn_or_an_angle_by_less_is_no_wrap(
    tmp_path: Path, name: str, turn: float
) -> None:
    dataset = turning(tmp_path / "turns", name, turn)
    assert not [f for f in check_up(dataset).findings if "full turn" in f.what]
