"""The folder of a deployed policy: its graph, a description, a page of its own, and a loop that runs it."""

import json
import shutil
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from astra_data.core.digest import file_digest
from astra_data.core.manifest import write_manifest
from astra_data.core.provenance import origin
from astra_data.dataset.atomic import atomic_folder, refuse_existing
from astra_data.dataset.columns import Column
from astra_data.deployment.graph import INPUTS, ONNX, OUTPUTS, write_graph
from astra_data.deployment.lerobot.files import write_lerobot_files
from astra_data.deployment.page import page
from astra_data.pipeline.trained_policy import trained_policy
from astra_data.policies.running_policy import RunningPolicy
from astra_data.worlds.own_code import file_of

DESCRIPTION, LOOP, PAGE = "policy.json", "run_policy.py", "README.md"
FORMAT = 1
"""Of `DESCRIPTION`."""


def deploy(run: Path, row: str, out: Path, *, seed: int = 0, percent: int | None = None) -> Path:
    """Write the policy of a row into the new folder `out`, which runs without this package; return it.

    Args:
        run: the folder of a run.
        row: a row of its recipe, such as "astra_plus".
        out: the folder to write.
        seed: one of the recipe's seeds.
        percent: the size of the dataset, where the recipe sweeps over sizes.

    Raises:
        BadInputError: the row trains no policy, an artifact of it is not there, was altered or made from
            another than lies there now, code of the task cannot be written as a graph, or `out` exists.
    """
    refuse_existing(out)
    trained = trained_policy(run, row, seed=seed, percent=percent)
    deployed = trained.running()
    digests = {stage: file_digest(path) for stage, path in trained.files.items()}
    with atomic_folder(out) as folder:
        written = write_graph(deployed, folder)
        about = {
            "format": FORMAT,
            "row": row,
            "seed": seed,
            **({} if percent is None else {"percent": percent}),
            "trained_on": {"dataset": trained.file.dataset, "hash": trained.file.content_hash},
            **describe(deployed, written.parts, trained.recorded()),
            "largest_difference": written.apart,
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
    deployed: RunningPolicy,
    parts: Mapping[str, int],
    recorded: tuple[Sequence[float], Sequence[float]] | None = None,
) -> dict[str, Any]:
    """Return what one has to know to run a policy.

    Args:
        deployed: the policy.
        parts: the sizes of the parts of its hidden state.
        recorded: least and largest of each value of the state in the data it was learned from, if known.
    """
    task = deployed.task
    encoder = "target" if deployed.target_encoder is not None else "source"
    least, largest = zip(*task.limits.values(), strict=True)
    ranges = {"recorded_least": recorded[0], "recorded_largest": recorded[1]} if recorded else {}
    return {
        "task": task.name,
        "instruction": task.instruction,
        "rate_hz": 1.0 / task.timestep_s,
        "file": ONNX,
        "inputs": list(INPUTS),
        "outputs": list(OUTPUTS),
        "state": _values(task.state, "state") | ranges,
        "goal": _values(task.goal, "goal") if task.goal else {"names": []},
        "command": _values(task.action, "command") | {"least": least, "largest": largest},
        "hidden": {"size": sum(parts.values()), "start": 0.0, "parts": dict(parts)},
        "encoder": encoder if deployed.source_encoder is not None else None,
        "observed": deployed.observed,
        "command_limit": deployed.command_limit if task.plane else None,
    }


def _values(column: Column, called: str) -> dict[str, Any]:
    """Return the names of a column's values, and their units and frames where they are known."""
    names = column.names or tuple(f"{called}_{index}" for index in range(column.size))
    known = column.astra or {}
    kept = {f"{key}s": known[key] for key in ("unit", "frame") if key in known}
    return {"column": column.name, "names": list(names), **kept}
