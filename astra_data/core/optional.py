"""Packages of the optional extras."""

import re
from importlib import import_module
from importlib.metadata import requires
from pathlib import Path
from typing import Any

from astra_data.core.errors import BadInputError

EXTRAS = {
    **dict.fromkeys(("torch", "mujoco", "gymnasium", "gymnasium_robotics", "safetensors", "scipy"), "sim"),
    **dict.fromkeys(("matplotlib", "PIL", "pandas"), "report"),
    **dict.fromkeys(("onnxruntime", "onnxscript"), "deploy"),
    **dict.fromkeys(("lerobot", "datasets"), "lerobot"),
    **dict.fromkeys(("mcap", "mcap_protobuf", "mcap_ros2"), "mcap"),
    **{"h5py": "hdf5", "minari": "minari", "ray": "ray", "trackio": "trackio", "rerun": "view"},
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
    """Return the command that installs an `extra`: by its project in a checkout, elsewhere by its packages."""
    if (_ROOT / "pyproject.toml").is_file():
        return f"uv sync --extra {extra}"
    entries = (entry.partition(";") for entry in requires("astra-data") or ())
    wanted = [name for name, _, marker in entries if re.search(rf"extra == ['\"]{extra}['\"]", marker)]
    return f"pip install {' '.join(f'"{name.strip()}"' for name in wanted)}"


def _not_installed(package: str) -> BadInputError:
    return BadInputError(f"{package} is needed but not installed: {how_to_install(EXTRAS[package])}")
