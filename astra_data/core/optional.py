"""Packages of the optional extras."""

from importlib import import_module
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
    "rliable": "report",
    "jinja2": "report",
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


def optional(module: str) -> Any:  # noqa: ANN401 - a module
    """Import `module` of a package in `EXTRAS`.

    Raises:
        BadInputError: it is not installed; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise _not_installed(module.partition(".")[0]) from error


def missing_extra(error: ModuleNotFoundError) -> BadInputError | None:
    """Return an error that says which extra brings the missing module; None if none of `EXTRAS` does."""
    package = (error.name or "").partition(".")[0]
    return _not_installed(package) if package in EXTRAS else None


def how_to_install(extra: str) -> str:
    """Return the commands that install an `extra`, for messages."""
    return f'uv sync --extra {extra} in a checkout, else pip install "astra-data[{extra}]"'


def _not_installed(package: str) -> BadInputError:
    return BadInputError(f"{package} is needed but not installed: {how_to_install(EXTRAS[package])}")
