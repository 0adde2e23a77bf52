"""Packages of the optional extras."""

from importlib import import_module
from typing import Any

from astra_data.core.errors import BadInputError


def optional(module: str, extra: str) -> Any:  # noqa: ANN401 - a module
    """Import `module`, which is installed with the optional extra `extra`.

    Raises:
        BadInputError: it is not installed; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise BadInputError(f"{package} is needed and not installed: {cure(extra)}") from error


def cure(extra: str) -> str:
    """Return the commands that install an `extra`, for messages."""
    return f'uv sync --extra {extra} in a checkout, else pip install "astra-data[{extra}]"'
