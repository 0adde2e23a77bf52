"""Options that are the settings of a stage, made from its config model: one per field.

The model is imported only when its command is called or helps, so that `astra-data --help` answers at once.
"""

from collections.abc import Mapping
from importlib import import_module
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import click
from typer.core import TyperCommand, TyperOption

from astra_data.core.config import Config
