"""The exceptions that the toolkit raises; all expected ones are AstraDataErrors."""

import re
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import requires
from pathlib import Path
from typing import Any

from astra_data.core.naming import printable, shortened


class AstraDataError(Exception):
    """Any expected error; the command line prints one line, without a traceback, and exits with 1."""


class BadInputError(AstraDataError):
    """A value, file or column is not what was expected."""


class RecipeError(AstraDataError):
    """A recipe is missing, malformed or contradicts itself."""


class MissingStageError(AstraDataError):
    """An earlier stage has not been run yet; the message names the command that runs it."""


class CorruptDatasetError(AstraDataError):
    """A dataset on disk is incomplete or was altered."""


class SharingError(AstraDataError):
    """A remote storage cannot be reached, refuses, or holds something else."""


class DiskError(AstraDataError):
    """A disk is full, read-only, failing or gone; the message names the file and what to do."""


_LONGEST = 300  # characters of an error message of a library that are shown


def in_short(error: Exception) -> str:
    """Return the first sentence of an error message, of bounded length and printable."""
    return shortened(printable(str(error).split("\n")[0].split(". ")[0].rstrip(".:")), _LONGEST)


def unmet(checks: Mapping[str, object]) -> list[str]:
    """Return what is wrong: the keys of `checks` whose values do not hold."""
    return [fault for fault, holds in checks.items() if not holds]


EXTRAS = {
    **dict.fromkeys(("torch", "mujoco", "gymnasium", "gymnasium_robotics", "safetensors", "scipy"), "sim"),
    **dict.fromkeys(("matplotlib", "PIL", "pandas"), "report"),
    **dict.fromkeys(("onnxruntime", "onnxscript"), "deploy"),
    **dict.fromkeys(("lerobot", "datasets", "av"), "lerobot"),
    **dict.fromkeys(("mcap", "mcap_protobuf", "mcap_ros2"), "mcap"),
    **{"h5py": "hdf5", "minari": "minari", "ray": "ray", "rerun": "view"},
}  # which extra brings each package
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
