"""The folder of a deployed policy: its graph, a description, a page of its own, and a loop that runs it."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from astra_data.core.artifact import write_manifest
from astra_data.core.durable import atomic_folder, file_digest, refuse_existing
from astra_data.core.errors import BadInputError
from astra_data.core.provenance import origin
from astra_data.dataset.columns import ACTION, GOAL, STATE, Column
from astra_data.pipeline.trained_policy import trained_policy
from astra_data.policies.running_policy import RunningPolicy
from astra_data.reports.blocks import table
from astra_data.worlds.user_code import file_of

DESCRIPTION, LOOP, PAGE = "policy.json", "run_policy.py", "README.md"
FORMAT = 1  # of `DESCRIPTION`
TYPE = "astra_data"  # the name under which LeRobot knows the policy and the environment
_FILES = files("astra_data.deployment")
_POSITIONS = {"m", "cm", "mm", "rad", "deg", "°"}


def page(about: Mapping[str, Any]) -> str:
    """Return the page, in Markdown, of a policy with the description `about`."""
    # A command that tells a position has no value that stops the robot.
    is_position = _POSITIONS.intersection(about["command"].get("units", ()))
    values = {key: about[key] for key in ("task", "row", "seed", "rate_hz")} | about["trained_on"]
    values |= {"minute": round(60 * about["rate_hz"]), "hidden": about["hidden"]["size"]}
    values |= {"stop": None if is_position else [0.0] * len(about["command"]["names"])}
    for name in ("state", "goal", "command"):
        lists = {key: entries for key, entries in about[name].items() if not isinstance(entries, str)}
        titles = [key.removesuffix("s").replace("_", " ") for key in lists]
        rows = zip(*lists.values(), strict=True)
        cells = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row] for row in rows]
        shown = table(titles, cells, words=len(titles)) if lists["names"] else "None: all episodes have the same."
        values |= {f"{name}_names": lists["names"], f"{name}s": len(lists["names"]), name: shown}
    return (_FILES / f"{PAGE}.template").read_text(encoding="utf-8").format(**values)


def deploy(run: Path, row: str, out: Path, *, seed: int = 0, percent: int | None = None) -> Path:
    """Write the policy of a row of a run into the new folder `out`, which runs without this package; return it.

    `seed` is one of the recipe's, `percent` the size of the dataset, where the recipe sweeps over sizes.
    """
    refuse_existing(out)
    trained = trained_policy(run, row, seed=seed, percent=percent)
    deployed = trained.running()
    if deployed.sensing is not None:
        advice = "which a folder does not: act with astra_data.load_policy, or align without inputs"
        raise BadInputError(f"{row} acts on {', '.join(deployed.sensing.inputs)} in place of states, {advice}")
    from astra_data.deployment.graph import write_graph

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
        (folder / LOOP).write_bytes((_FILES / LOOP).read_bytes())
        write_manifest(folder, digests)
    return out


def describe(
    deployed: RunningPolicy, parts: Mapping[str, int], recorded: tuple[Sequence[float], Sequence[float]] | None = None
) -> dict[str, Any]:
    """Return what running a policy takes: `parts` of its hidden state, least and largest `recorded` states, names."""
    from astra_data.deployment.graph import INPUTS, ONNX, OUTPUTS

    task = deployed.task
    encoders = {"target": deployed.target_encoder, "source": deployed.source_encoder}
    least, largest = zip(*task.limits.values(), strict=True)

    def values(column: Column, called: str) -> dict[str, Any]:
        names = column.names or [f"{called}_{index}" for index in range(column.size)]
        known = column.astra or {}
        kept = {f"{key}s": known[key] for key in ("unit", "frame") if key in known}
        return {"column": column.name, "names": list(names), **kept}

    return {
        "task": task.name,
        "instruction": task.instruction,
        "rate_hz": 1.0 / task.timestep_s,
        "file": ONNX,
        "inputs": list(INPUTS),
        "outputs": list(OUTPUTS),
        "state": values(task.state, "state")
        | (dict(zip(("recorded_least", "recorded_largest"), recorded, strict=True)) if recorded else {}),
        "goal": values(task.goal, "goal") if task.goal else {"names": []},
        "command": values(task.action, "command") | {"least": least, "largest": largest},
        "hidden": {"size": sum(parts.values()), "start": 0.0, "parts": dict(parts)},
        "encoder": next((name for name, encoder in encoders.items() if encoder is not None), None),
        "observed": deployed.observed,
        "command_limit": deployed.command_limit if task.plane else None,
    }


def write_lerobot_files(about: Mapping[str, Any], folder: Path) -> None:
    """Write what LeRobot reads of a policy described by `about`: settings, and pipelines, which only batch."""

    def features(kind: str, name: str, column: str) -> dict[str, Any]:
        size = len(about[column]["names"])
        return {name: {"type": kind, "shape": [size]}} if size else {}

    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    renamed = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
    batched = {"registry_name": "to_batch_processor", "config": {}}
    config = {
        "type": TYPE,
        "input_features": features("STATE", STATE, "state") | features("ENV", GOAL, "goal"),
        "output_features": features("ACTION", ACTION, "command"),
        "device": "cpu",
        "push_to_hub": False,
    }
    before, after = "policy_preprocessor", "policy_postprocessor"
    pipelines = {before: [renamed, batched, device], after: [device]}
    written = {name: {"name": name, "steps": steps} for name, steps in pipelines.items()}
    for name, values in (written | {"config": config}).items():
        (folder / f"{name}.json").write_text(json.dumps(values, indent=1))
