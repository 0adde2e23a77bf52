"""A folder for a new robot: a task, a recipe, a mapping of its logs, a test and a page."""

import importlib.util
import json
import keyword
import math
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.config import did_you_mean
from astra_data.core.durable import atomic_folder
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, REWARD, STATE, SUCCESS, TERMINATED
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import locate, names_at_home
from astra_data.io.guessing import GAP_STEPS, HEADING, Field, Logs, Role, csv_files, guess, logs_of
from astra_data.pipeline.first_simulator import DIRECT, SimulatorKind, filled, first_simulator, unpacked

_COLUMNS: dict[Role, str] = {"time": "time", "state": STATE, "command": ACTION, "goal": GOAL}
_COLUMNS |= {"failure": TERMINATED, "success": SUCCESS, "reward": REWARD}
_TAKEN = sys.stdlib_module_names | {"astra_data", "conftest", "logs", "numpy", "pytest", "torch"}
"""Names whose file would be found in place of a module, or is that of the mapping."""
_FILES = {"task.py": "{}.py", "recipe.toml": "{}.toml", "test.py": "test_{}.py", "README.md": "README.md"}


def write_robot(name: str, out: Path, logs: Sequence[Path]) -> SimulatorKind:
    """Write the new folder `out` of a robot, of CSV files, folders of them, or a dataset; return its simulator."""
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise BadInputError(f"'{name}': expected a name of a-z, 0-9 and _, such as my_cart, that begins with a letter")
    spec = importlib.util.find_spec(name)
    is_installed = spec and {"site-packages", "dist-packages"} & {*Path(spec.origin or "").parts}
    if name in _TAKEN or keyword.iskeyword(name) or is_installed:
        raise BadInputError(f"'{name}': expected a name that Python does not use, such as my_{name}")
    with atomic_folder(out) as folder:
        data = _dataset(logs)
        found = logs_of(data) if data else guess(logs)
        simulator = first_simulator(found)
        values = _values(name, simulator)
        values |= dict.fromkeys(("and_mapping", "versions", "import_line", "mapping_row"), "")
        if data:
            values |= {"data": _code(str(data.root.resolve())), "dataset": shlex.quote(str(data.root.resolve()))}
        else:
            values |= _of_mapping(name, [path.resolve() for path in logs])
        for template, written in (_FILES if data else _FILES | {"logs.toml": "logs.toml"}).items():
            (folder / written.format(name)).write_text(filled(template, values), encoding="utf-8")
    return simulator


def _dataset(logs: Sequence[Path]) -> Dataset | None:
    """Return the dataset that `logs` name; None where they are files, or folders of them."""
    folders = []
    for place in logs:
        try:
            folder = locate(place)
        except BadInputError:
            if place.exists():
                continue
            if "@" in place.name:
                raise
            close = did_you_mean(str(place), names_at_home())
            raise BadInputError(f"{place}: no such file, folder or dataset{close}") from None
        folders += [folder] if folder != place or (folder / INFO_PATH).is_file() else []
    if folders and len(logs) > 1:
        advice = "`astra-data merge` them first"
        raise BadInputError(f"{' and '.join(map(str, logs))}: expected logs, or one dataset: {advice}")
    return Dataset.open(folders[0]) if folders else None


def _of_mapping(name: str, logs: Sequence[Path]) -> dict[str, str]:
    """Return what recipe and page say where the data are imported from `logs`, by a mapping."""
    folder = logs[0].parent
    is_whole = len(logs) > 1 and all(path.is_file() for path in logs) and csv_files(folder) == sorted(logs)
    places = shlex.join(map(str, [folder] if is_whole else logs))
    return {
        "logs": places,
        "data": _code(f"{name}-logs@data-1.0.0"),
        "dataset": f"{name}-logs",
        "and_mapping": " and `logs.toml`",
        "versions": " After a change of `logs.toml` give it a `version`, and the recipe's `data` the same.",
        "import_line": f"astra-data import {places} --mapping logs.toml  # a dataset, {name}-logs\n",
        "mapping_row": "| `logs.toml` | which fields of the logs become which columns, in which units |\n",
    }


def _values(name: str, simulator: SimulatorKind) -> dict[str, str]:
    logs = simulator.logs
    states, commands = logs.of("state"), logs.of("command")
    lines = ["| field | used as | unit | factor | why |", "|---|---|---|---|---|"]
    for one in logs.fields:
        called = one.name.replace("|", r"\|")
        lines.append(f"| `{called}` | {one.taken_for} | {one.unit} | {one.scale:.4g} | {one.why} |")
    time = [f"time = {_code(field.name)}\ntime_scale = {field.scale!r}\n" for field in logs.of("time")]
    split = [f"field = {_code(field.name)}\n" for field in logs.of("episode")[:1]]
    split += [f"gap_s = {GAP_STEPS / logs.rate!r}  # a longer step begins a new episode\n"] * len(time)
    row, command = logs.values(states)[0][:1], logs.values(commands)[0][:1]
    first = simulator.episodes()[0][0][:1]
    given = np.concatenate(logs.values(commands))
    lows, highs = given.min(axis=0), given.max(axis=0)
    unit = 10.0 ** np.floor(np.log10(np.where(highs > lows, highs - lows, 1.0))) / 1e3
    lows, highs = np.floor(lows / unit) * unit, np.ceil(highs / unit) * unit  # outwards
    highs = np.where(highs > lows, highs, lows + unit)  # of a command that never changes
    ranges = zip(commands, lows, highs, strict=True)
    bounds = ", ".join(f"{_code(command.short)}: {_code((low, high))}" for command, low, high in ranges)
    values = {
        "name": name,
        "called": simulator.called,
        "simulator": simulator.code(),
        "simulator_line": simulator.described,
        "timestep_s": repr(1 / logs.rate),
        "rate_hz": f"{logs.rate}" + (f"  # CHECK: {logs.uneven}" if logs.uneven else ""),
        "time": "".join(time),
        "not_finite": 'not_finite = "split"  # CHECK: rows with a missing number end the episode\n'
        * bool(logs.left_out),
        "split": "".join(["\n[split]\n", *split]) if split else "",
        "columns": "\n".join(_column(role, logs) for role in _COLUMNS if logs.of(role)),
        "command_size": str(len(commands)),
        "state": _declared(STATE, states),
        "action": _declared(ACTION, commands),
        "goal": f"\n    goal={_declared(GOAL, logs.of('goal'))}," if logs.of("goal") else "",
        "bounds": f"{{{bounds}}}",
        "still": f"; {logs.still}" if logs.still else "",
        "horizon": str(max(map(len, logs.values(states)))),
        "guesses": "\n".join(lines),
        "row": _code(row[0]),
        "phi": _code(first[0]),
        "command": _code(command[0]),
        "landed": _code(simulator.after(first, [command])[0]),
    }
    return values | {"objective": _objective(simulator, values)}


def _declared(name: str, fields: Sequence[Field]) -> str:
    names, units = _code(tuple(field.short for field in fields)), _code([field.unit for field in fields])
    return f'Column("{name}", size={len(fields)}, names={names}, astra={{"unit": {units}}})'


def _objective(simulator: SimulatorKind, values: dict[str, str]) -> str:
    """Return the code of the objective, to come to where logs go; add to `values` what the template names of it."""
    logs, is_planar = simulator.logs, simulator.called != DIRECT
    recorded = [states for states, _ in simulator.episodes()]
    width = 2 if is_planar else len(simulator.names)
    spans = np.ptp(np.concatenate(recorded), axis=0)
    spans = np.where(spans > 0, spans, 1.0)  # of what never moves
    shares = 1.0 if is_planar else spans
    goal, way = _typical([states[:, :width] / shares for states in recorded], logs)
    taken = _goals_of(simulator, is_planar=is_planar)
    drawn, pairs, text = [], [], ""
    for entry in simulator.entries:
        at = [simulator.names.index(one) for one in entry.names]
        begins = np.array([states[0, at] for states in recorded])
        is_angle = len(at) > 1
        pairs.append(_arc(np.arctan2(*begins.T[::-1])) if is_angle else (begins.min(), begins.max()))
        drawn += entry.shown("np.cos({})", "np.sin({})")
    if goals := logs.of("goal"):
        every = np.concatenate(logs.values(goals))
        use = "" if taken else "; nothing below uses them"
        bounds = f"{_code(every.min(axis=0))}, {_code(every.max(axis=0))}, (count, {len(goals)})"
        text = f"\n    goal_size = {len(goals)}\n\n    def draw_goals(self, rng, count):  # CHECK: where goals are{use}"
        text += f"\n        return rng.uniform({bounds})"
    sizes = [f"\n{name} = {value!r}  # CHECK: fitted to the logs" for name, value in simulator.constants.items()]
    values |= {
        "goals": text,
        "starts": unpacked([entry.name for entry in simulator.entries]),
        "lows": _code([low for low, _ in pairs]),
        "highs": _code([high for _, high in pairs]),
        "start_size": str(len(pairs)),
        "drawn": ", ".join(drawn),
        "target": f"goal[..., {taken}]" if taken else "state.new_tensor(GOAL)",
        "names": _code(tuple(simulator.names)),
        "constants": "".join(sizes),
        "goal_line": "" if taken else f"GOAL = {_code(tuple(goal * shares))}  # CHECK: where to go\n",
        "close": f"{way / 10:.2g}",
        "also": ", and the other states" if len(simulator.names) > 4 else "",
        "others": ", *state[..., 4:].unbind(-1)" if len(simulator.names) > 4 else "",
        "range": f"{way:.3g}" if is_planar else _code(tuple(spans)),
    }
    return filled("planar.py" if is_planar else "direct.py", values)


def _goals_of(simulator: SimulatorKind, *, is_planar: bool) -> list[int]:
    """Return which values of recorded goals are for the position, or for all states; none if none are."""
    goals = simulator.logs.of("goal")
    if not is_planar:
        return list(range(len(goals))) if len(goals) == len(simulator.names) else []
    axes = [entry.fields[0].plain.rpartition("_")[2][:3] for entry in simulator.entries[:2]]
    found = [number for axis in axes for number, one in enumerate(goals) if f"_{axis}" in one.plain]
    return found if len(found) == 2 else [0, 1] if len(goals) == 2 else []


def _typical(episodes: Sequence[Floats], logs: Logs) -> tuple[Floats, float]:
    """Return the end (D,) of the episode of median length, failed ones apart, and its distance or the farthest."""
    failed = [any(bool(one[field.name].any()) for field in logs.of("failure")) for one in logs.episodes]
    kept = [values for values, fails in zip(episodes, failed, strict=True) if not fails] or episodes
    ways = [float(np.linalg.norm(values[-1] - values[0])) for values in kept]
    typical = int(np.argsort(ways)[len(ways) // 2])
    farthest = max(float(np.linalg.norm(values - values[0], axis=1).max()) for values in episodes)
    return kept[typical][-1], ways[typical] or farthest or 1.0


def _arc(angles: Floats) -> tuple[float, float]:
    """Return where the shortest arc that contains all angles begins and ends."""
    order = np.sort(angles)
    gaps = np.diff(order, append=order[0] + math.tau)
    widest = int(np.argmax(gaps))
    begin = float(order[(widest + 1) % len(order)])
    return begin, begin + max(0.0, math.tau - float(gaps[widest]))


def _column(role: Role, logs: Logs) -> str:
    fields, lines = logs.of(role), [f'[columns."{_COLUMNS[role]}"]']
    if fields[0].why.endswith("(CHECK)"):
        called = f"{fields[0].name} is {fields[0].why.removesuffix(' (CHECK)')}"
        lines.insert(0, f"# CHECK: {called}: a failure? If a success, write next.success; if neither, delete this")
    lines.append(f"fields = {_code([field.name for field in fields])}")
    if role == "time":  # in s since the first row, for `inspect`, where float32 can hold it
        times = np.concatenate(logs.values(fields))
        if np.spacing(np.float32(np.ptp(times))) > 0.01 / logs.rate:
            return ""
        fields = (replace(fields[0], short="time", unit="s", offset=float(-times[0, 0])),)
    if role in ("time", "state", "command", "goal"):
        keys = {"names": "short", "unit": "unit", "scale": "scale", "offset": "offset"}
        lines += [f"{key} = {_code([getattr(field, of) for field in fields])}" for key, of in keys.items()]
    if role == "state" and "position" in (roles := _roles(fields)):
        lines.append(f"role = {_code(roles)}  # how a turn and a shift of the ground act; CHECK the invariant")
    return "\n".join(line for line in lines if not re.fullmatch(r"offset = \[(0\.0(, )?)+\]", line)) + "\n"


def _roles(fields: Sequence[Field]) -> list[str]:
    """Return what each state is to a turn and a shift of the ground: the one pair x, y, and headings."""
    roles = ["heading" if one.unit == "rad" and HEADING.fullmatch(one.short) else "invariant" for one in fields]
    for at, (one, other) in enumerate(pairwise(fields)):
        if (one.short, other.short) == ("x", "y") and one.unit == other.unit == "m":
            roles[at : at + 2] = ["position", "position"]
    return roles


def _code(value: str | Iterable[str] | Iterable[float]) -> str:
    """Return a text, a tuple or a list as Python and, but for tuples, TOML; numbers as exact as float32."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    inside = ", ".join(_code(one) if isinstance(one, str) else repr(float(f"{one:.9g}") + 0.0) for one in value)
    if isinstance(value, tuple):
        return f"({inside},)" if len(value) == 1 else f"({inside})"
    return f"[{inside}]"
