"""The folder of a deployed policy: its graph, a description, a page of its own, and a loop that runs it."""

import json
import shutil
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from astra_data.core.artifact import write_manifest
from astra_data.core.durable import atomic_folder, file_digest, refuse_existing
from astra_data.core.provenance import origin
from astra_data.dataset.columns import ACTION, GOAL, STATE, Column
from astra_data.deployment.graph import INPUTS, ONNX, OUTPUTS, write_graph
from astra_data.pipeline.trained_policy import trained_policy
from astra_data.policies.running_policy import RunningPolicy
from astra_data.reports.blocks import table
from astra_data.worlds.user_code import file_of

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
    state, goal, command = (about[name] for name in ("state", "goal", "command"))
    # A command that tells a position has no value that stops the robot.
    is_position = _POSITIONS.intersection(command.get("units", ()))
    values: dict[str, Any] = {key: about[key] for key in ("task", "row", "seed", "rate_hz")} | about["trained_on"]
    values |= {"minute": round(60 * about["rate_hz"]), "hidden": about["hidden"]["size"]}
    values |= {"stop": None if is_position else [0.0] * len(command["names"])}
    for name, column in (("state", state), ("goal", goal), ("command", command)):
        values |= {f"{name}_names": column["names"], f"{name}s": len(column["names"]), name: _table(column)}
    if not goal["names"]:
        values["goal"] = "None: all episodes have the same."
    return _PAGE.format(**values)


def _table(values: Mapping[str, Any]) -> str:
    """Return the lists in the description of a column as a table, one row for each value."""
    lists = {key: entries for key, entries in values.items() if not isinstance(entries, str)}
    one = {"names": "name", "units": "unit", "frames": "frame"}
    titles = [one.get(key, key.replace("_", " ")) for key in lists]
    rows = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in row]
        for row in zip(*lists.values(), strict=True)
    ]
    return table(titles, rows, words=len(titles))


DESCRIPTION, LOOP, PAGE = "policy.json", "run_policy.py", "README.md"
FORMAT = 1  # of `DESCRIPTION`


def deploy(run: Path, row: str, out: Path, *, seed: int = 0, percent: int | None = None) -> Path:
    """Write the policy of a row of a run into the new folder `out`, which runs without this package; return it.

    `seed` is one of the recipe's, `percent` the size of the dataset, where the recipe sweeps over sizes.
    """
    refuse_existing(out)
    trained = trained_policy(run, row, seed=seed, percent=percent)
    deployed = trained.running()
    digests = {stage: file_digest(path) for stage, path in trained.files.items()}
    with atomic_folder(out) as folder:
        parts, apart = write_graph(deployed, folder)
        about = {"format": FORMAT, "row": row, "seed": seed} | ({} if percent is None else {"percent": percent})
        about |= {
            "trained_on": {"dataset": trained.file.dataset, "hash": trained.file.content_hash},
            **describe(deployed, parts, trained.recorded()),
            "largest_difference": apart,
            "made_from": digests | file_of(trained.settings["task"]),
            **origin(),
        }
        (folder / DESCRIPTION).write_text(json.dumps(about, indent=1))
        (folder / PAGE).write_text(page(about), encoding="utf-8")
        write_lerobot_files(about, folder)
        with as_file(files("astra_data.deployment") / LOOP) as loop:
            shutil.copyfile(loop, folder / LOOP)
        write_manifest(folder, digests)
    return out


def describe(
    deployed: RunningPolicy, parts: Mapping[str, int], recorded: tuple[Sequence[float], Sequence[float]] | None = None
) -> dict[str, Any]:
    """Return what one has to know to run a policy whose hidden state has `parts` of these sizes.

    `recorded` are least and largest of each value of the state in the data it was learned from, if known.
    """
    task = deployed.task
    encoders = {"target": deployed.target_encoder, "source": deployed.source_encoder}
    least, largest = zip(*task.limits.values(), strict=True)
    ranges = {"recorded_least": recorded[0], "recorded_largest": recorded[1]} if recorded else {}
    graph = {"file": ONNX, "inputs": list(INPUTS), "outputs": list(OUTPUTS)}
    about = {"task": task.name, "instruction": task.instruction, "rate_hz": 1.0 / task.timestep_s, **graph}
    return about | {
        "state": _values(task.state, "state") | ranges,
        "goal": _values(task.goal, "goal") if task.goal else {"names": []},
        "command": _values(task.action, "command") | {"least": least, "largest": largest},
        "hidden": {"size": sum(parts.values()), "start": 0.0, "parts": dict(parts)},
        "encoder": next((name for name, encoder in encoders.items() if encoder is not None), None),
        "observed": deployed.observed,
        "command_limit": deployed.command_limit if task.plane else None,
    }


def _values(column: Column, called: str) -> dict[str, Any]:
    """Return the names of a column's values, and their units and frames where they are known."""
    names = column.names or tuple(f"{called}_{index}" for index in range(column.size))
    known = column.astra or {}
    kept = {f"{key}s": known[key] for key in ("unit", "frame") if key in known}
    return {"column": column.name, "names": list(names), **kept}


TYPE = "astra_data"  # the name under which LeRobot knows the policy and the environment


def write_lerobot_files(about: Mapping[str, Any], folder: Path) -> None:
    """Write what LeRobot reads of a policy with the description `about`: settings, and its pipelines.

    These only batch: scaling is inside the policy.
    """

    def features(kind: str, name: str, column: str) -> dict[str, Any]:
        size = len(about[column]["names"])
        return {name: {"type": kind, "shape": [size]}} if size else {}

    def steps(*named: tuple[str, dict[str, Any]]) -> list[dict[str, Any]]:
        return [{"registry_name": f"{name}_processor", "config": config} for name, config in named]

    cpu = ("device", {"device": "cpu", "float_dtype": None})
    batched = steps(("rename_observations", {"rename_map": {}}), ("to_batch", {}), cpu)
    config = {
        "type": TYPE,
        "input_features": features("STATE", STATE, "state") | features("ENV", GOAL, "goal"),
        "output_features": features("ACTION", ACTION, "command"),
        "device": "cpu",
        "push_to_hub": False,
    }
    pipelines = {"policy_preprocessor": batched, "policy_postprocessor": steps(cpu)}
    written = {name: {"name": name, "steps": them} for name, them in pipelines.items()}
    for name, values in (written | {"config": config}).items():
        (folder / f"{name}.json").write_text(json.dumps(values, indent=1))
