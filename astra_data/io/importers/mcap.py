"""MCAP: messages of asynchronous topics, as JSON, protobuf or ROS 2 (CDR), resampled to fps.

Times are the messages' log times. Files are read message by message, twice: how often topics come decides
when rows are taken (`io/resampling.py`).
"""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.mcap_file import McapFile, Timeline
from astra_data.io.recording import VALUE_BYTES, Block, Source
from astra_data.io.resampling import Resampler

SUFFIXES = (".mcap",)
Message = tuple[int, Mapping[str, Array]]
"""The time of a message in ns, by the recorder's clock, and the values of its fields."""
_MISSING = object()
_NAMES = "name"  # the part of a message that names the values of the lists beside it, as of joints in ROS

_log = logging.getLogger(__name__)


class MessageField:
    """What a field takes of each message: `/topic:path.in.message`, or `/topic:path.in.message[name]`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.topic, _, path = name.partition(":")
        named = re.fullmatch(r"(.+?)\[(.+)\]", path)
        self._keys = (named[1] if named else path).split(".")
        self.wanted = named[2] if named else ""  # of the names beside a list
        self._names: list[str] | None = None

    def names_in(self, content: Any) -> list[str]:
        """Return the names of the values in a message; empty if it has none."""
        for key in self._keys[:-1]:
            content = _part(content, key)
        return _names_in(content) or []

    def value(self, content: Any) -> Array:
        """Return the numbers, or the text, in a message; a time in s and ns as whole ns."""
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

    def _lacks(self, owner: Any, depth: int) -> str:
        key, where = self._keys[depth], self._path(depth)
        if _is_list(owner):
            return f"no part '{key}' in {where}, which has {len(owner)} values, counted from 0"
        parts = _parts(owner)
        known = f", which has {', '.join(parts)}" if parts else ""
        return f"no part '{key}' in {where}{known}{did_you_mean(key, parts).partition('; known')[0]}"

    def _path(self, depth: int) -> str:
        return ":".join(filter(None, (self.topic, ".".join(self._keys[:depth]))))

    def _named(self, owner: Any, values: Any) -> Any:
        """Return the one of `values` that the list of names beside them calls as is wanted."""
        where, names = self._path(len(self._keys)), _names_in(owner)
        if names is None or not _is_list(values):
            raise BadInputError(f"'{self.name}': {where} is no list with a list '{_NAMES}' beside it")
        if self.wanted not in names:
            raise BadInputError(f"no '{self.wanted}' in {where}{did_you_mean(self.wanted, names)}")
        if len(values) != len(names):
            raise BadInputError(f"{where} has {len(values)} values for {len(names)} names")
        return values[names.index(self.wanted)]

    def _check_order(self, owner: Any, values: Any) -> None:
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


def check(source: Source, mapping: ImportMapping) -> None:
    """Raise BadInputError where the index of a file lacks topics."""
    McapFile(source, {name.partition(":")[0] for name in mapping.all_fields})


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield rows at the rate `mapping.fps`."""
    _check_mapping(mapping, str(source))
    by_topic: dict[str, list[MessageField]] = {}
    for each in map(MessageField, mapping.all_fields):
        by_topic.setdefault(each.topic, []).append(each)
    file = McapFile(source, by_topic.keys())
    fields = _by_publisher(file, by_topic)
    gaps_s = [mapping.split.gap_s or 0, *(column.gap_s or 0 for column in mapping.columns.values())]
    timeline = Timeline(file, gaps_s[0], max(gaps_s))
    topic_of = {field.name: topic for topic, each in fields.items() for field in each}
    resampler = Resampler(mapping, str(source), timeline.moments, topic_of)
    known = sorted(file.topics - by_topic.keys())
    rows: dict[str, list[Message]] = {topic: [] for topic in fields}
    first = count = 0
    is_back = False
    for begins, goes_back, row in resampler.rows(_messages(source, timeline, fields)):
        if begins and count > first:
            yield replace(_block(source, rows, fields), row=first, is_back=is_back, known=known)
            rows, first = {topic: [] for topic in fields}, count
        is_back = goes_back if begins else is_back
        for topic, message in row.items():
            rows[topic].append(message)
        count += 1
        source.refuse_beyond(count * VALUE_BYTES * len(mapping.all_fields))
    if silent := sorted(resampler.topics.keys() - resampler.times.keys()):
        raise BadInputError(f"{source}: no messages on {', '.join(silent)}")
    for silence in resampler.endings():
        _log.warning("%s", silence)
    if count > first:
        block = replace(_block(source, rows, fields), row=first, is_back=is_back, known=known)
        yield replace(block, torn=file.is_cut, notes=resampler.unevenness())


def _by_publisher(file: McapFile, fields: dict[str, list[MessageField]]) -> dict[str, list[MessageField]]:
    """Treat what several publishers send to one topic, each its own joints, as topics of their own, named by both."""
    named = {topic for topic, each in fields.items() if any(field.wanted for field in each)}
    sent: dict[str, set[frozenset[str]]] = {topic: set() for topic in named}
    for topic, message in file.messages() if named else ():
        if topic in named:
            sent[topic].add(_sent(file, fields[topic], message))
    split = {topic: each for topic, each in fields.items() if topic not in named}
    for topic, groups in sent.items():
        wanted = {field.wanted for field in fields[topic] if field.wanted}
        if len(groups) < 2 or not wanted <= set().union(*groups):
            split[topic] = fields[topic]  # of one publisher, or without what is wanted
            continue
        is_apart = sum(map(len, groups)) == len(wanted)
        of = {n: f"{topic}[{','.join(sorted(group)) if is_apart else n}]" for group in groups for n in group}
        for each in fields[topic]:
            split.setdefault(of.get(each.wanted) or min(of.values()), []).append(each)
        file.streams[topic] = partial(_streams, file, fields[topic], of)
    return split


def _sent(file: McapFile, fields: Sequence[MessageField], message: Any) -> frozenset[str]:
    """Return which of the names that `fields` want are in a message of theirs."""
    content = file.decoder(message.channel_id)(message.data)
    return frozenset(field.wanted for field in fields if field.wanted in field.names_in(content))


def _streams(file: McapFile, fields: Sequence[MessageField], of: dict[str, str], message: Any) -> list[str]:
    return sorted({of[name] for name in _sent(file, fields, message)})


def _messages(
    source: Source, timeline: Timeline, fields: Mapping[str, list[MessageField]]
) -> Iterator[tuple[str, int, Message, bool]]:
    """Yield messages as a `Resampler` takes them."""
    sizes: dict[str, tuple[int, ...]] = {}
    for topic, time, log_time, content, is_back in timeline.messages():
        values, faults = dict[str, Array](), list[str]()
        for each in fields[topic]:
            try:
                values[each.name] = each.value(content)
            except BadInputError as error:
                faults.append(str(error))
        changed = [name for name, v in values.items() if sizes.setdefault(name, v.shape) != v.shape]
        faults += [f"{', '.join(changed)} changes in size"] if changed else []
        if faults:
            raise BadInputError(f"{source} at {log_time} ns: {'; '.join(faults)}")
        yield topic, time, (log_time, values), is_back


def _block(
    source: Source, rows: Mapping[str, Sequence[Message]], fields: Mapping[str, Sequence[MessageField]]
) -> Block:
    """Return the rows of an episode, with each topic's messages; their times name what is not finite."""
    values, places = {}, dict[int, str]()
    for topic, messages in rows.items():
        for name in [field.name for field in fields[topic]]:
            values[name] = np.stack([message[name] for _, message in messages])
            if values[name].dtype.kind == "f":
                odd = np.flatnonzero(~np.isfinite(values[name].reshape(len(messages), -1)).all(axis=1)).tolist()
                places = {row: f"{source} at {messages[row][0]} ns" for row in odd} | places
    return Block(values, str(source), starts=True, places=places)


def _check_mapping(mapping: ImportMapping, origin: str) -> None:
    odd = [name for name in mapping.all_fields if not all(name.partition(":"))]
    faults = [f"field '{name}', expected '/topic:path.in.message'" for name in odd]
    if mapping.split.gap_s is None:
        faults.append("split.gap_s is missing: the longest time for which a topic's last value is held")
    if mapping.time is not None:
        faults.append("time: leave it out, the messages' log times are used")
    if all(column.latched for column in mapping.columns.values()):
        faults.append("every column is latched, expected one that is not")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _part(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(key, _MISSING)
    if key.isdecimal():
        return value[int(key)] if hasattr(value, "__len__") and int(key) < len(value) else _MISSING
    return getattr(value, key, _MISSING)


def _parts(value: Any) -> list[str]:
    """Return the names of the parts of a message, of JSON, protobuf or ROS 2."""
    if isinstance(value, Mapping):
        return list(value)
    if descriptor := getattr(value, "DESCRIPTOR", None):
        return [part.name for part in descriptor.fields]
    return list(getattr(value, "__slots__", ()))


def _is_list(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | Mapping)


def _names_in(owner: Any) -> list[str] | None:
    """Return the list of names in a message; None if it has none."""
    names = _part(owner, _NAMES)
    if not _is_list(names) or not all(isinstance(name, str) for name in names):
        return None
    return list(names)
