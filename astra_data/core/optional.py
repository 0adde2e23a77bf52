"""Packages of the optional extras."""

import re
from importlib import import_module
from importlib.metadata import requires
from pathlib import Path
from typing import Any

from astra_data.core.errors import BadInputError

EXTRAS = {
    "torch": "sim",
    "mujoco": "sim",
    "gymnasium": "sim",
    "gymnasium_robotics": "sim",
    "safetensors": "sim",
    "scipy": "sim",
    "matplotlib": "report",
    "PIL": "report",
    "pandas": "report",
    "onnxruntime": "deploy",
    "onnxscript": "deploy",
    "lerobot": "lerobot",
    "datasets": "lerobot",
    "h5py": "hdf5",
    "minari": "minari",
    "mcap": "mcap",
    "mcap_protobuf": "mcap",
    "mcap_ros2": "mcap",
    "ray": "ray",
    "trackio": "trackio",
    "rerun": "view",
}
"""Which extra brings each package."""
_ROOT = Path(__file__).parents[2]


def optional(module: str) -> Any:  # noqa: ANN401 - a module
    """Import `module` of a package in `EXTRAS`."""
    try:
        return import_module(module)
    except ImportError as error:
        raise _not_installed(module.partition(".")[0]) from error


def missing_extra(error: ModuleNotFoundError) -> BadInputError | None:
    """Return an error that says which extra brings the missing module; None if none of `EXTRAS` does."""
    package = (error.name or "").partition(".")[0]
    return _not_installed(package) if package in EXTRAS else None


def how_to_install(extra: str) -> str:
    """Return the command that installs an `extra`, for messages: in a checkout, by its project.

    Elsewhere it names the packages themselves, as this one may have come from a file.
    """
    if (_ROOT / "pyproject.toml").is_file():
        return f"uv sync --extra {extra}"
    entries = (entry.partition(";") for entry in requires("astra-data") or ())
    wanted = [name for name, _, marker in entries if re.search(rf"extra == ['\"]{extra}['\"]", marker)]
    return f"pip install {' '.join(f'"{name.strip()}"' for name in wanted)}"


def _not_installed(package: str) -> BadInputError:
    return BadInputError(f"{package} is needed but not installed: {how_to_install(EXTRAS[package])}")
