"""A robot that follows its commands late, in what is known of it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Column, Episode
from astra_data.dataset.writer import DatasetWriter
from astra_data.grounding import diagnosis
from astra_data.pipeline.stages.pair import pair
from astra_data.reports.diagnosis import diagnosis_page
from astra_data.robots.registry import pairing_named

SIMULATOR = '''
import torch
from astra_data import Column

class Axes:
    """Two carts on rails that move at once as they are told, [x, y]."""
    abstract_state = Column("abstract.state", size=2, names=("x", "y"), astra={"unit": ["m", "m"]})
    parameters = {"timestep_s": 0.1}
    def __init__(self, num_envs):
        self.state, self.rate = torch.zeros(num_envs, 2), torch.nn.Parameter(torch.tensor(0.1))
    @staticmethod
    def abstraction(state):
        return state[:, :2]
    def reset_to(self, state, rows=None):
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)
    def step(self, action):
        self.state = self.state + self.rate * action
        return self.state
'''


def recorded(
    folder: Path,
    dead: tuple[int, int] = (0, 0),
    lag_s: float = 0.0,
    *,
    same: bool = False,
    gains: tuple[float, float] = (0.9, 0.5),
    drift: str = "",
    deaf: bool = False,
    falls: int = 0,
) -> diagnosis.Diagnosis:
    """Return the diagnosis of 12 recordings of 150 steps, in which commands act `dead` steps late and with a lag.

    A current moves x, the same in a recording or drawn in each step; the first `falls` of them end at once.
    """
    (folder / "axes.py").write_text(
        SIMULATOR.replace("* action", "* action * torch.tensor([0.9, 0.0])") if deaf else SIMULATOR
    )
    rng, follows = np.random.default_rng(0), 1.0 if not lag_s else 1 - np.exp(-0.1 / lag_s)
    columns = [Column(STATE, size=5, names=("x", "y", "vx", "vy", "current")), Column(NEXT_STATE, size=5)]
    columns += [Column(ACTION, size=2, names=("pull", "push"))]
    about = {"name": "logs", "stage": "import"}
    with DatasetWriter(folder / "logs", columns, fps=10, task="rail", description=about) as writer:
        for number in range(12):
            command = rng.uniform(-1.0, 1.0, (170, 2)).repeat(rng.integers(1, 6, 170), axis=0)[:170]
            if same:
                command[:, 1] = command[:, 0]
            state = np.zeros((151, 5))
            currents = {"steady": np.full(151, rng.normal()), "gusts": rng.normal(size=151)}
            state[:, 4] = currents.get(drift, np.zeros(151))
            for step in range(150):
                told = [command[10 + step - dead[axis], axis] for axis in (0, 1)]
                velocity = state[step, 2:4] + follows * (np.array(told) * gains - state[step, 2:4])
                state[step + 1, :2] = state[step, :2] + 0.1 * (velocity + np.array([state[step, 4], 0.0]))
                state[step + 1, 2:4] = velocity
            values = {STATE: state[:-1], NEXT_STATE: state[1:], ACTION: command[10:160]}
            kinds = {column.name: column.dtype for column in columns}
            ends = 1 if number < falls else 150
            writer.add(Episode(number, {name: each[:ends].astype(kinds[name]) for name, each in values.items()}, {}))
    simulator = f"{folder / 'axes.py'}:Axes"
    return diagnosis.diagnose(pair(simulator, dataset=folder / "logs", out=folder / "pairs"), simulator)


@pytest.mark.parametrize("dead", [(0, 5), (1, 3), (2, 4)])
def test_dead_times_and_gains_are_found_for_each_command(tmp_path: Path, dead: tuple[int, int]) -> None:
    found = recorded(tmp_path, dead)
    assert [one.name for one in found.responses] == ["pull", "push"]
    for one, steps, gain in zip(found.responses, dead, (0.9, 0.5), strict=True):
        value, low, high = one.delay_s
        assert value == pytest.approx(0.1 * steps, abs=0.01) and low <= value <= high < low + 0.05
        assert one.gain[0] == pytest.approx(gain, abs=0.02)
    late = {line.what.split()[0] for line in found.findings if "later than in the simulator" in line.what}
    assert late == {name for name, steps in zip(("pull", "push"), dead, strict=True) if steps}


def test_a_time_constant_is_a_delay_and_is_hidden_state(tmp_path: Path) -> None:
    found = recorded(tmp_path, lag_s=0.3)
    # The mean lag of a first-order lag that is sampled each 0.1 s.
    assert found.responses[0].delay_s[0] == pytest.approx(0.1 / (np.exp(0.1 / 0.3) - 1), abs=0.02)
    present, late, history, whole = (value[0] for value in found.explained.values())
    assert present < 0.8 and min(late, history, whole) > 0.99
    [line] = [line for line in found.findings if "the present explains" in line.what]
    assert line.advice == "a delay or a lag of the commands is what is hidden: any grounding learns it"
    assert not any("whole recorded state" in line.what for line in found.findings)
    # Of a lag all is known after a few recordings.
    assert any("these are enough" in line.advice for line in found.findings)
    assert found.forecast and found.forecast.more == 18 and found.forecast.sizes == (4, 5, 7, 10)


def test_a_current_that_lasts_is_hidden_state_and_gusts_are_seen_in_what_is_recorded(tmp_path: Path) -> None:
    (tmp_path / "steady").mkdir()
    found = recorded(tmp_path / "steady", drift="steady")
    present, late, history, _ = found.explained.values()
    assert late[0] - present[0] < 0.05 and history[0] > 0.99 and late[0] < 0.9
    assert any("train `astra_plus`" in line.advice for line in found.findings)
    gusts = recorded(tmp_path, drift="gusts")
    present, late, history, whole = gusts.explained.values()
    assert history[0] - present[0] < 0.05 and whole[0] > 0.95
    # y, all of whose error is that of a gain, and x, of which that is a hundredth of the gusts.
    assert present[0] == pytest.approx(0.5, abs=0.05) and present.shape == (201,) and present.min() >= 0
    assert any(
        line.advice == "the simulator may gain from more of it, such as current, in φ" for line in gusts.findings
    )
    assert not any("train `astra_plus`" in line.advice for line in gusts.findings)


def test_what_one_parameter_would_mend_is_not_hidden_state(tmp_path: Path) -> None:
    found = recorded(tmp_path)
    assert found.explained["the present abstract state and command"][0] > 0.99
    assert any("nothing hidden shows" in line.advice for line in found.findings)
    x, y = found.missed
    # y lags half of 0.1 m/s² behind, x a tenth; a command of ±1 has an RMS of 1/√3.
    assert y.error == pytest.approx(0.05 / np.sqrt(3), rel=0.1) and x.error == pytest.approx(0.01 / np.sqrt(3), rel=0.1)
    assert y.still == pytest.approx(y.error, rel=0.01) and " times as large where " in y.where


def test_a_command_without_effect_is_warned_of(tmp_path: Path) -> None:
    whats = [line.what for line in recorded(tmp_path, gains=(0.9, 0.0)).findings if line.severity == "warning"]
    assert any(what.startswith("push has no effect that can be seen (") for what in whats)
    assert not any(what.startswith("pull has") for what in whats)


def test_a_command_that_the_simulator_ignores_is_named(tmp_path: Path) -> None:
    found = recorded(tmp_path, deaf=True)
    [line] = [line for line in found.findings if line.what == "push has no effect in the simulator"]
    assert line.severity == "note" and not found.responses[1].weights.any()
    x, y = found.missed  # where it only rounds, there is no place where it errs more
    assert next(iter(found.explained.values()))[0] > 0.99
    assert x.error < 1e-6 and not x.where and y.error == pytest.approx(0.1 * 0.5 / np.sqrt(3), rel=0.1)


def test_how_far_it_is_is_told(tmp_path: Path) -> None:
    found, notes = recorded(tmp_path, lag_s=0.2), list[tuple[float, str]]()
    diagnosis.diagnose(tmp_path / "pairs", f"{tmp_path / 'axes.py'}:Axes", lambda *note: notes.append(note))
    lags = len(found.responses[0].weights) - 1
    steps = 12 * (150 - lags)
    expected = [(lag / (lags + 1), f"{steps * (1 + 2 * lag):,} steps of the simulator") for lag in range(lags + 1)]
    assert lags > 1 and notes == expected


@pytest.mark.parametrize(("falls", "gains", "explained"), [(5, (0.9, 0.5), 4), (11, (0.9, 0.5), 0), (0, (1.0, 1.0), 0)])
def test_recordings_that_are_too_short_and_simulators_that_do_not_err_count_for_no_forecast(
    tmp_path: Path, falls: int, gains: tuple[float, float], explained: int
) -> None:
    found = recorded(tmp_path, falls=falls, gains=gains)
    assert found.recordings == 12 and len(found.explained) == explained and not found.forecast
    assert any("too few recordings" in line.what for line in found.findings) == (falls > 0)


def test_a_tasks_commands_are_within_1_unless_it_has_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    columns = (Column(ACTION, size=2),)
    monkeypatch.setattr(diagnosis, "pairing_named", lambda name: replace(pairing_named(name), columns=columns))
    assert [given[2:] for given in recorded(tmp_path).commands.values()] == [(-1.0, 1.0)] * 2


def test_commands_that_only_vary_together_are_warned_of(tmp_path: Path) -> None:
    assert any(line.what == "pull and push only ever vary together" for line in recorded(tmp_path, same=True).findings)


@pytest.mark.parametrize(
    ("now", "expected", "gain", "advice"),
    [
        (0.5, 0.48, (0.04, 0.01, 0.2), "these are enough"),
        (0.01, 0.005, (0.5, 0.4, 0.6), "these are enough"),
        (0.5, 0.4, (0.2, 0.1, 0.3), "record more, above all where fast"),
        (0.5, 0.4, (0.2, -0.1, 0.3), "more may help or not: record some more, above all where fast, and look again"),
    ],
)
def test_a_forecast_says_more_only_where_its_interval_does(
    now: float, expected: float, gain: tuple[float, float, float], advice: str
) -> None:
    found = diagnosis.Forecast((4, 8), np.full((2, 12), now), 15, (expected, expected - 0.1, expected + 0.1), gain)
    [line] = diagnosis._of_forecast(
        found, [diagnosis.Missed("x", "m", 1.0, 1.0, "2.0 times as large where fast as where not")] * 2
    )
    assert line.advice.startswith(advice)
    assert line.what.startswith(
        f"of the simulator's error, histories leave {now:.2f}, with 15 recordings {expected:.2f} ["
    )
    found = diagnosis._extrapolated((7, 10, 20), np.tile([[0.9], [0.23], [0.2075]], 3), 30)  # 0.2 + 3 / recordings²
    assert found.expected == pytest.approx([0.2 + 3 / 900] * 3) and found.gain == pytest.approx(
        [1 - found.expected[0] / 0.2075] * 3
    )
    [line] = diagnosis._of_forecast(None, [])
    assert line.advice == "record 10 or more"


def test_the_page_shows_all_of_it(tmp_path: Path) -> None:
    text = diagnosis_page("rail", recorded(tmp_path, (0, 2)), 0.1)
    assert re.search(r"\| push \| 0\.20\d \[0\.[12]\d\d, 0\.2\d\d\] \| 0\.\d{3} \[0\.\d{3}, 0\.\d{3}\] \|   █ \|", text)
    assert "- **push acts 0.2" in text and "| and the errors of 8 steps before | 1.00 [1.00, 1.00] |" in text
    assert "(12 recordings, 1800 steps)" in text and "| pull | -0.986 | 0.98 | -0.997 | 0.994 |" in text
    assert re.search(r"\| y \| m \| 0\.0\d+ \|", text)


def test_what_explains_more_is_told_only_where_its_interval_does() -> None:
    def of(value: float, low: float, high: float) -> Floats:
        return np.array([value, *np.linspace(low, high, 200)])

    present, late, sure, unsure, whole = (
        of(0.3, 0.3, 0.3),
        of(0.3, 0.3, 0.3),
        of(0.6, 0.5, 0.7),
        of(0.6, 0.2, 0.7),
        0.62,
    )
    told = [line.advice for line in diagnosis._of_hidden_state([present, late, sure, of(whole, 0.6, 0.7)], ["current"])]
    assert told == ["there is state that neither the abstract state nor commands show: train `astra_plus`"]
    told = [line.advice for line in diagnosis._of_hidden_state([present, late, unsure, of(whole, 0.6, 0.7)], [])]
    assert told == ["for the motion nothing hidden shows: `nas`, or a parameter of the simulator, may do"]
    told = [line.advice for line in diagnosis._of_hidden_state([present, late, late, of(whole, 0.6, 0.7)], [])]
    assert told[-1] == "the simulator may gain from more of it in φ"
