"""Packages that not everybody needs."""

from importlib import import_module
from typing import Any

from astra_data.errors import BadInputError


def optional(module: str, extra: str) -> Any:  # noqa: ANN401 - a module
    """Import a module of one of the optional extras.

    Raises:
        BadInputError: it is not installed; the message holds the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise BadInputError(
            f'{package} is needed and not installed: pip install "astra-data[{extra}]"'
        ) from error
