"""Which message of each topic a row takes, where it is known which one is due."""

import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE, Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.resampling import Resampler, uneven_steps, usual_periods

MS = 10**6


def sampled(
    fps: int,
    odom: Array,
    commands: Array,
    *,
    latched: bool = False,
    state_gap_s: float | None = None,
    more: dict[str, dict[str, object]] | None = None,
) -> tuple[Resampler, list[tuple[int, int]]]:
    """Return, for each row, which message of each topic it holds; times are in ms.

    `more` are further columns or, as `split`, keys of that table.
    """
    columns = dict(more or {})
    split: dict[str, object] = {"gap_s": 0.4} | columns.pop("split", {})
    command = {"fields": ("/cmd:k",), "latched": latched}
    mapping = ImportMapping.model_validate(
        {
            "name": "log",
            "task": "drive",
            "fps": fps,
            "columns": {STATE: {"fields": ("/odom:k",), "gap_s": state_gap_s}, ACTION: command, **columns},
            "split": split,
        }
    )
    times = {"/odom": odom, "/cmd": commands}
    of = {field: field.partition(":")[0] for field in mapping.all_fields}
    resampler = Resampler(mapping, "log", {topic: (t * MS).astype(np.int64) for topic, t in times.items()}, of)
    messages = sorted((t, topic, k) for topic, series in times.items() for k, t in enumerate(series))
    rows = [row for _, row in resampler.rows((topic, round(t * MS), k) for t, topic, k in messages)]
    return resampler, [(row["/odom"], row["/cmd"]) for row in rows]


@pytest.mark.parametrize("late_ms", [1.0, 12.0, -12.0])
@pytest.mark.parametrize(("phase_ms", "lead"), [(0.0, 0), (1.0, 0), (10.0, 0), (40.0, 1), (49.0, 1)])
def test_jitter_neither_repeats_nor_skips_a_state(phase_ms: float, lead: int, late_ms: float) -> None:
    """At 20 Hz, every third state is late; it meets the command that is in force for most of its step."""
    odom = 1000 + 50.0 * np.arange(100)
    odom[1::3] += late_ms
    resampler, rows = sampled(20, odom, 1000 + phase_ms + 50.0 * np.arange(-3, 97))
    # The command of the same number came 150 ms before, less its phase.
    expected = [(k, k + 3 - lead) for k in range(97 + lead)]
    assert rows[: len(expected)] == expected and resampler.unevenness() == ()


@pytest.mark.parametrize("phase_ms", [18.0, 32.0])
def test_jitter_moves_no_command_to_another_state(phase_ms: float) -> None:
    commands = phase_ms + 50.0 * np.arange(100)
    commands[1::3] += 12
    commands[2::3] -= 12
    resampler, rows = sampled(20, 50.0 * np.arange(100), commands)
    assert {k - command for k, command in rows} == {0 if phase_ms < 25 else 1} and resampler.unevenness() == ()


def test_a_state_that_falls_silent_is_held_for_as_long_as_it_may_be() -> None:
    """The last state is at 500 ms; the row of 900 ms is 400 ms after it, as long as the longest gap."""
    resampler, rows = sampled(20, 50.0 * np.arange(11), 50.0 * np.arange(60))
    assert len(rows) == 19 and resampler.silences == {"/odom": 1}


@pytest.mark.parametrize("early_ms", [0.0, 1200.0])
def test_a_pause_before_all_topics_are_there_ends_nothing(early_ms: float) -> None:
    """A command alone, long before the states and the commands of a drive."""
    odom, commands = 2000 + 50.0 * np.arange(20), 2000 + 50.0 * np.arange(20)
    resampler, rows = sampled(20, odom, np.insert(commands, 0, early_ms))
    assert rows == [(k, k + 1) for k in range(20)] and not resampler.silences


@pytest.mark.parametrize("late_ms", [2000.0, 7_200_000.0])
def test_clocks_that_never_meet_are_refused_in_a_line(late_ms: float) -> None:
    odom = 50.0 * np.arange(20)
    told = rf"log: /cmd begins {late_ms / 1000 - 0.95:.4g} s after the last message of /odom, .* clocks differ"
    with pytest.raises(BadInputError, match=told):
        sampled(20, odom, late_ms + odom)
    assert sampled(20, odom, 1350 + odom)[1]  # 0.4 s, as long as a state may be held


def test_no_row_is_made_up_after_the_last_state() -> None:
    """The last command came just before a state that was not recorded any more."""
    _, rows = sampled(20, 50.0 * np.arange(20), 49 + 50.0 * np.arange(20))
    assert rows == [(k, k - 1) for k in range(1, 20)]


def test_a_period_is_the_mean_one_of_the_messages_that_go_on() -> None:
    """Jitter, a pause, a message that is lost, and one that is written twice change nothing."""
    times = 50.0 * np.arange(99)
    times[1::3] += 20
    times[2::3] -= 20
    times = np.concatenate([times, times[-1] + 60_000 + 50.0 * np.arange(90), times[:5]])
    moments = {"/odom": np.sort(np.delete(times, 120)), "/map": np.array([0, 300]), "/goal": np.array([3])}
    periods = usual_periods({topic: each.astype(np.int64) for topic, each in moments.items()}, 400)
    assert periods == {"/odom": pytest.approx(50, rel=0.01)}


def test_a_topic_that_rows_repeat_is_told_with_its_rate_and_counts() -> None:
    resampler, rows = sampled(40, 50.0 * np.arange(101), 25.0 * np.arange(201))
    assert len(rows) == 201
    assert resampler.unevenness() == (
        "log: /odom comes 20 times a second, fps is 40: 100 of 200 rows repeat its message before, "
        "0 of 100 messages are in no row",
    )


@pytest.mark.parametrize(
    ("more", "counts"),
    [
        ({"stamp": {"fields": ("/odom:stamp",), "dtype": "int64"}}, False),
        ({"wheels": {"fields": ("/odom:velocity",)}}, False),
        ({"next.observation.state": {"fields": ("/odom:next",)}}, False),
        ({"action.gripper": {"fields": ("/odom:gripper",)}}, True),
        ({"next.success": {"fields": ("/odom:arrived",)}}, True),
        ({"next.reward": {"fields": ("/odom:reward",)}}, True),
        ({"bumper": {"fields": ("/odom:bumper",), "dtype": "bool"}}, True),
        ({"split": {"field": "/odom:trial"}}, True),
        ({"split": {"ends": ("/odom:end",)}}, True),
    ],
)
def test_messages_in_no_row_are_told_where_commands_flags_outcomes_or_ends_are_lost(
    more: dict[str, dict[str, object]], counts: bool
) -> None:
    """A state at 100 Hz whose messages hold something else, too."""
    resampler, _ = sampled(20, 10.0 * np.arange(496), 50.0 * np.arange(100), more=more)
    told = (
        "log: /odom comes 100 times a second, fps is 20: 0 of 99 rows repeat its message before, "
        "396 of 495 messages are in no row",
    )
    assert resampler.unevenness() == (told if counts else ())


@pytest.mark.parametrize("gap_s", [0.13, 0.31])
def test_the_gap_of_a_column_is_that_of_its_topics_alone(gap_s: float) -> None:
    """Each row after a state that is the last holds it for so long, while commands may be held for longer."""
    odom = 50.0 * np.arange(41)
    _, rows = sampled(20, odom, 300.0 * np.arange(20), state_gap_s=gap_s)
    held = [k for k, _ in rows].count(40) - 1
    assert held == gap_s * 1000 // 50 and [k for k, _ in rows][: len(odom)] == list(range(41))


@pytest.mark.parametrize(
    ("rate", "fps", "steps", "proposed"),
    [
        (30, 20, "33 and 67", "10 or 15 or 30"),
        (29.98, 20, "33 and 67", "10 or 15 or 30"),
        (50, 20, "40 and 60", "10 or 25 or 50"),
        (250, 100, "8 and 12", "50 or 125 or 250"),
        (31, 20, "32 and 65", "31"),
    ],
)
def test_rates_that_divide_are_proposed(rate: float, fps: int, steps: str, proposed: str) -> None:
    assert uneven_steps("/odom", rate, fps) == (
        f"/odom comes {round(rate)} times a second, of which {fps} fps is no whole fraction: "
        f"steps of {steps} ms alternate; take {proposed}"
    )
