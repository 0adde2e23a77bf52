"""The page that lies beside a deployed policy."""

from collections.abc import Mapping
from typing import Any

from astra_data.reports.formatting import table

_PAGE = """\
# {task}: {row}, seed {seed}

A policy that `astra-data deploy` wrote. It runs with NumPy and onnxruntime alone, {rate_hz:g} times a
second:

```python
from run_policy import RobotPolicy, run

policy = RobotPolicy(
    rate_hz={rate_hz:g},
    state={state_names},
    goal={goal_names},
)
run(policy, measure, send, goal, steps={minute}, stop={stop})
```

`measure()` returns the robot's state, `send(command)` gives it a command, and `stop` is the command that
stops it, which is sent in the end, after an error and after Ctrl-C: all of these are yours. Zeros stop
what is commanded by speeds, and move what is commanded by positions: there, None leaves the last command.
`policy.start()` begins an episode and `policy.act(state, goal)` takes one step. Another rate, other
values, values that are not finite and states far outside the recorded range, as of mm for m, are refused
with a `ValueError`, and so are files that were altered. `pip install numpy onnxruntime` brings all that it
takes; `python run_policy.py` tries it in the middle of the recorded range.

## State

{state}

## Goal

{goal}

## Command

{command}

## Graph

`policy.onnx` is a graph of one robot and one step, in float32: `state` (1, {states}), `goal` (1, {goals})
and `hidden` (1, {hidden}) in, `command` (1, {commands}) and `next_hidden` (1, {hidden}) out. All values are
in the task's units: scaling, φ, the encoder and the memory are inside. `hidden` is zeros when an episode
begins, and after that what the last step gave as `next_hidden`.

## Where it comes from

Learned from {dataset} (hash `{hash}`). `policy.json` has all of this for programs, with the digests of
the files that it was made from and the versions of the packages; `manifest.json` has the digests of the
files here.
"""

_POSITIONS = {"m", "cm", "mm", "rad", "deg", "°"}


def page(about: Mapping[str, Any]) -> str:
    """Return the page, in Markdown, of a policy with the description `about`."""
    return _PAGE.format(
        **{key: about[key] for key in ("task", "row", "seed", "rate_hz")},
        minute=round(60 * about["rate_hz"]),
        stop=_stop(about["command"]),
        state_names=about["state"]["names"],
        goal_names=about["goal"]["names"],
        state=_table(about["state"]),
        goal=_table(about["goal"]) if about["goal"]["names"] else "None: all episodes have the same.",
        command=_table(about["command"]),
        states=len(about["state"]["names"]),
        goals=len(about["goal"]["names"]),
        commands=len(about["command"]["names"]),
        hidden=about["hidden"]["size"],
        dataset=about["trained_on"]["dataset"],
        hash=about["trained_on"]["hash"],
    )


def _stop(command: Mapping[str, Any]) -> list[float] | None:
    """Return the command that stops the robot: None where the units of any tell a position."""
    is_position = _POSITIONS.intersection(command.get("units", ()))
    return None if is_position else [0.0] * len(command["names"])


def _table(values: Mapping[str, Any]) -> str:
    """Return the lists in the description of a column as a table, one row for each value."""
    lists = {key: entries for key, entries in values.items() if not isinstance(entries, str)}
    one = {"names": "name", "units": "unit", "frames": "frame"}
    titles = [one.get(key, key.replace("_", " ")) for key in lists]
    rows = (map(_text, row) for row in zip(*lists.values(), strict=True))
    return table(titles, rows, words=len(titles))


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
