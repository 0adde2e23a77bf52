"""What LeRobot reads in the folder of a policy: its settings, and what it does with what it is shown."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from astra_data.dataset.columns import ACTION, GOAL, STATE

TYPE = "astra_data"
"""The name under which LeRobot knows the policy and the environment."""

_ON_CPU = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
_BATCHED: list[dict[str, Any]] = [
    {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
    {"registry_name": "to_batch_processor", "config": {}},
    _ON_CPU,
]
_PIPELINES = {"policy_preprocessor": _BATCHED, "policy_postprocessor": [_ON_CPU]}
"""Scaling is inside the policy."""


def write_lerobot_files(about: Mapping[str, Any], folder: Path) -> None:
    """Write the files of a policy with the description `about` into its folder."""
    sizes = {column: len(about[column]["names"]) for column in ("state", "goal", "command")}
    inputs = {STATE: _feature("STATE", sizes["state"])}
    if sizes["goal"]:
        inputs[GOAL] = _feature("ENV", sizes["goal"])
    config = {
        "type": TYPE,
        "input_features": inputs,
        "output_features": {ACTION: _feature("ACTION", sizes["command"])},
        "device": "cpu",
        "push_to_hub": False,
    }
    written = {name: {"name": name, "steps": steps} for name, steps in _PIPELINES.items()}
    for name, values in (written | {"config": config}).items():
        (folder / f"{name}.json").write_text(json.dumps(values, indent=1))


def _feature(kind: str, size: int) -> dict[str, Any]:
    return {"type": kind, "shape": [size]}
