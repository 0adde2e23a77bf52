"""Values of messages by their paths: `/odom:pose.pose.position.x`, `/joint_states:velocity[left_wheel]`."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array

_MISSING = object()
_NAMES = "name"
"""The part of a message that names the values of the lists beside it, as of joints in ROS."""


class MessageField:
    """A field of a mapping: what it takes of each message of a topic.

    Attributes:
        name: the field.
        topic: that it is of.
        wanted: the name of the value in a list with names beside it; "" where it is no such one.
    """

    def __init__(self, name: str) -> None:
        """Take the field `name`, `/topic:path.in.message` or `/topic:path.in.message[name of the value]`."""
        self.name = name
        self.topic, _, path = name.partition(":")
        named = re.fullmatch(r"(.+?)\[(.+)\]", path)
        self._keys = (named[1] if named else path).split(".")
        self.wanted = named[2] if named else ""
        self._names: list[str] | None = None

    def names_in(self, content: Any) -> list[str]:  # noqa: ANN401 - any message
        """Return the names of the values in a message; empty if it has none."""
        for key in self._keys[:-1]:
            content = _part(content, key)
        return _names_in(content) or []

    def value(self, content: Any) -> Array:  # noqa: ANN401 - any message
        """Return the numbers, or the text, in a message; a time in s and ns as whole ns.

        Raises:
            BadInputError: the message lacks them, or its list is in another order than in messages before.
        """
        before = owner = None
        part = content
        for depth, key in enumerate(self._keys):
            before, owner, part = owner, part, _part(part, key)
            if part is _MISSING:
                raise BadInputError(self._lacks(owner, depth))
        if self.wanted:
            part = self._named(owner, part)
        elif _is_list(part):
            self._check_order(owner, part)
        elif _is_list(owner):
            self._check_order(before, owner)
        value = np.array(list(part) if _is_list(part) else part)
        if value.dtype.kind in "biufU":
            return value
        if sorted(_parts(part)) == ["nanosec", "sec"]:
            return np.array(_part(part, "sec") * 10**9 + _part(part, "nanosec"))
        raise BadInputError(f"'{self.name}' is neither a number nor a list of numbers")

    def _lacks(self, owner: Any, depth: int) -> str:  # noqa: ANN401 - any part of a message
        key, where = self._keys[depth], self._path(depth)
        if _is_list(owner):
            return f"no part '{key}' in {where}, which has {len(owner)} values, counted from 0"
        parts = _parts(owner)
        known = f", which has {', '.join(parts)}" if parts else ""
        return f"no part '{key}' in {where}{known}{did_you_mean(key, parts).partition('; known')[0]}"

    def _path(self, depth: int) -> str:
        return ":".join(filter(None, (self.topic, ".".join(self._keys[:depth]))))

    def _named(self, owner: Any, values: Any) -> Any:  # noqa: ANN401 - any parts of a message
        """Return the one of `values` that the list of names beside them calls as is wanted."""
        where, names = self._path(len(self._keys)), _names_in(owner)
        if names is None or not _is_list(values):
            raise BadInputError(f"'{self.name}': {where} is no list with a list '{_NAMES}' beside it")
        if self.wanted not in names:
            raise BadInputError(f"no '{self.wanted}' in {where}{did_you_mean(self.wanted, names)}")
        if len(values) != len(names):
            raise BadInputError(f"{where} has {len(values)} values for {len(names)} names")
        return values[names.index(self.wanted)]

    def _check_order(self, owner: Any, values: Any) -> None:  # noqa: ANN401 - any parts of a message
        names = _names_in(owner)
        if names is None or len(names) != len(values) or names == self._names or self._keys[-1] == _NAMES:
            return
        if self._names is not None:
            by_name = self.name.removesuffix(f".{self._keys[-1]}" if self._keys[-1].isdecimal() else "")
            raise BadInputError(
                f"'{self.name}' is in another order than before: its names are {', '.join(names)}, and were "
                f"{', '.join(self._names)}; take each value by its name, '{by_name}[{self._names[0]}]'"
            )
        self._names = names


def _part(value: Any, key: str) -> Any:  # noqa: ANN401 - any message
    """Return part `key` of a message, `_MISSING` where there is none."""
    if isinstance(value, Mapping):
        return value.get(key, _MISSING)
    if key.isdecimal():
        return value[int(key)] if hasattr(value, "__len__") and int(key) < len(value) else _MISSING
    return getattr(value, key, _MISSING)


def _parts(value: Any) -> list[str]:  # noqa: ANN401 - any part of a message
    """Return the names of the parts of a message, of JSON, protobuf or ROS 2."""
    if isinstance(value, Mapping):
        return list(value)
    if descriptor := getattr(value, "DESCRIPTOR", None):
        return [part.name for part in descriptor.fields]
    return list(getattr(value, "__slots__", ()))


def _is_list(value: Any) -> bool:  # noqa: ANN401 - any part of a message
    return hasattr(value, "__len__") and not isinstance(value, str | Mapping)


def _names_in(owner: Any) -> list[str] | None:  # noqa: ANN401 - any part of a message
    """Return the list of names in a message; None if it has none."""
    names = _part(owner, _NAMES)
    if not _is_list(names) or not all(isinstance(name, str) for name in names):
        return None
    return list(names)
