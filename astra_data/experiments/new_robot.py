"""A folder for a robot of one's own: a task, a recipe, a mapping of its logs, a test and a page."""

import importlib.util
import json
import keyword
import math
import re
import shlex
import sys
import sysconfig
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.dataset.atomic import atomic_folder
from astra_data.dataset.columns import ACTION, GOAL, REWARD, STATE, SUCCESS, TERMINATED
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import locate, names_at_home
from astra_data.exchange.dataset_logs import logs_of
from astra_data.exchange.field_names import Role
from astra_data.exchange.guessing import guess
from astra_data.exchange.logs import Logs
from astra_data.experiments.fitted_kinds import Bicycle, Differential
from astra_data.experiments.planar_kinds import Holonomic, Planar
from astra_data.experiments.robot_kinds import Direct
from astra_data.experiments.written_values import numbers, significant, texts

_COLUMNS: dict[Role, str] = {
    "state": STATE,
    "command": ACTION,
    "failure": TERMINATED,
    "success": SUCCESS,
    "reward": REWARD,
}
_TAKEN = sys.stdlib_module_names | {"astra_data", "conftest", "logs", "numpy", "pytest", "torch"}
"""Names whose file would be found in place of a module, or is that of the mapping."""


def write_robot(name: str, out: Path, logs: Sequence[Path] = ()) -> Planar | Direct:
    """Write the new folder `out` of the robot `name`; return the simulator that it begins with, and its logs.

    Args:
        name: of the task: a-z, digits and _, and no module's.
        out: the folder to write.
        logs: CSV files, or folders of them; or one dataset. By default the logs are those of a made-up cart,
            which are written too.

    Raises:
        BadInputError: `name` is no name, `out` exists, or the logs are not there, or of no use: see `guess`
            and `logs_of`.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise BadInputError(
            f"'{name}': expected a name of a-z, 0-9 and _, such as my_cart, that begins with a letter"
        )
    if name in _TAKEN or keyword.iskeyword(name) or _is_installed(name):
        raise BadInputError(f"'{name}': expected a name that Python does not use, such as my_{name}")
    with atomic_folder(out) as folder:
        places = [path.resolve() for path in logs]
        if not places:
            _drive(folder / "logs")
        data = _dataset(logs)
        found = logs_of(data) if data else guess(places or [folder / "logs"])
        kinds = (Holonomic, Bicycle, Differential, Planar)
        kind = next(filter(None, (one.of(found) for one in kinds)), None) or Direct.of(found)
        values = _common(name, found) | kind.values()
        values["simulator"] = kind.simulator
        values |= _of_dataset(data.root, found) if data else _of_mapping(name, places)
        written_as = {
            kind.template: f"{name}.py",
            "recipe.toml": f"{name}.toml",
            "test.py": f"test_{name}.py",
            "README.md": "README.md",
        }
        for template, written in (written_as if data else written_as | {"logs.toml": "logs.toml"}).items():
            text = (files("astra_data.experiments") / f"robot_files/{template}.template").read_text()
            (folder / written).write_text(Template(text).substitute(values), encoding="utf-8")
    return kind


def _dataset(logs: Sequence[Path]) -> Dataset | None:
    """Return the dataset that `logs` name; None where they are files, or folders of them.

    Raises:
        BadInputError: one of several is a dataset, or nothing is there.
        CorruptDatasetError: the dataset is incomplete or was altered.
    """
    folders = [folder for place in logs if (folder := _folder(place))]
    if folders and len(logs) > 1:
        raise BadInputError(
            f"{' and '.join(map(str, logs))}: expected logs, or one dataset: `astra-data merge` them first"
        )
    return Dataset.open(folders[0]) if folders else None


def _folder(place: Path) -> Path | None:
    """Return the folder of the dataset that `place` names; None where it is another folder, or a file.

    Raises:
        BadInputError: there is no such place, or no such version.
    """
    try:
        folder = locate(place)
    except BadInputError:
        if place.exists():
            return None
        if "@" in place.name:
            raise
        close = did_you_mean(str(place), names_at_home())
        raise BadInputError(f"{place}: no such file, folder or dataset{close}") from None
    return folder if folder != place or (folder / INFO_PATH).is_file() else None


def _of_dataset(root: Path, logs: Logs) -> dict[str, str]:
    """Return what recipe, page and task say where the data are a dataset."""
    place = str(root.resolve())
    return {
        "data": _toml(place),
        "dataset": shlex.quote(place),
        "goals": _recorded_goals(logs),
    } | dict.fromkeys(("and_mapping", "versions", "import_line", "mapping_row"), "")


def _of_mapping(name: str, logs: Sequence[Path]) -> dict[str, str]:
    """Return what recipe and page say where the data are imported from `logs`, by a mapping."""
    places = shlex.join(map(str, logs)) or "logs"
    return {
        "logs": places,
        "data": _toml(f"{name}-logs@data-1.0.0"),
        "dataset": f"{name}-logs",
        "goals": "",
        "and_mapping": " and `logs.toml`",
        "versions": "\nAfter a change of `logs.toml` give it a `version`, and the recipe's `data` the same.",
        "import_line": f"astra-data import {places} --mapping logs.toml  # a dataset, {name}-logs\n",
        "mapping_row": "| `logs.toml` | which fields of the logs become which columns, in which units |\n",
    }


def _is_installed(name: str) -> bool:
    spec = importlib.util.find_spec(name)
    places = [Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")]
    return bool(spec and spec.origin and any(Path(spec.origin).is_relative_to(place) for place in places))


def _common(name: str, logs: Logs) -> dict[str, str]:
    """Return what the templates of every kind name."""
    states, commands = logs.of("state"), logs.of("command")
    given = np.concatenate(logs.values(commands))
    lows, highs = given.min(axis=0), given.max(axis=0)
    span = np.where(highs > lows, highs - lows, 1.0)
    unit = 10.0 ** np.floor(np.log10(span)) / 1e3  # a thousandth or less of the range, outwards
    lows, highs = np.floor(lows / unit) * unit, np.ceil(highs / unit) * unit
    highs = np.where(highs > lows, highs, lows + unit)  # of a command that never changes
    bounds = {
        field.short: (significant(low), significant(high))
        for field, low, high in zip(commands, lows, highs, strict=True)
    }
    horizon = max(len(values) for values in logs.values(states))
    time = [f"time = {_toml(field.name)}\ntime_scale = {field.scale!r}\n" for field in logs.of("time")[:1]]
    split = [f"field = {_toml(field.name)}\n" for field in logs.of("episode")[:1]]
    if time:
        split.append(f"gap_s = {5 / logs.rate!r}  # a longer step begins a new episode\n")
    check = logs.uneven if logs.of("time") else "the logs have no time field"
    lines = ["| field | used as | unit | factor | why |", "|---|---|---|---|---|"]
    for field in logs.fields:
        called = field.name.replace("|", r"\|")
        taken = f"`{called}` | {field.taken_for} | {field.unit} | {field.scale:.4g}"
        lines.append(f"| {taken} | {field.why} |")
    return {
        "name": name,
        "timestep_s": repr(1 / logs.rate),
        "rate_hz": f"{logs.rate}" + (f"  # CHECK: {check}" if check else ""),
        "time": "".join(time),
        "not_finite": 'not_finite = "split"  # CHECK: rows with a missing number end the episode\n'
        if logs.left_out
        else "",
        "split": "".join(["\n[split]\n", *split]) if split else "",
        "columns": "\n".join(_column(role, logs) for role in _COLUMNS if logs.of(role)) + _goals(logs),
        "window": str(max(2, min(20, horizon // 4))),
        "size": str(len(states)),
        "state": texts(field.short for field in states),
        "state_units": texts(field.unit for field in states),
        "command_size": str(len(commands)),
        "command_names": texts(field.short for field in commands),
        "command_units": texts(field.unit for field in commands),
        "row": json.dumps([significant(value) for value in logs.values(states)[0][0]]),
        "bounds": f"{{{', '.join(f'{_toml(name)}: {ends!r}' for name, ends in bounds.items())}}}",
        "still": f"; {logs.still}" if logs.still else "",
        "horizon": str(horizon),
        "guesses": "\n".join(lines),
    }


def _column(role: Role, logs: Logs) -> str:
    """Return the table of a column in a mapping."""
    fields, column = logs.of(role), _COLUMNS[role]
    lines = [f'[columns."{column}"]']
    if role in ("state", "command"):
        lines += [
            f"fields = {_toml([field.name for field in fields])}",
            f"names = {_toml([field.short for field in fields])}",
            f"unit = {_toml([field.unit for field in fields])}",
            f"scale = {_toml([field.scale for field in fields])}",
        ]
    else:
        lines.append(f"fields = {_toml([fields[0].name])}")
    return "\n".join(lines) + "\n"


def _goals(logs: Logs) -> str:
    """Return what to write into a mapping where a task takes the goals of the logs; nothing without any."""
    if not (goals := logs.of("goal")):
        return ""
    return (
        "\n# CHECK: the logs have goals, but the task drives to one place. To use the goals, give the\n"
        "# objective goal_size and draw_goals:\n"
        f'# [columns."{GOAL}"]\n# fields = {_toml([field.name for field in goals])}\n'
        f"# scale = {_toml([field.scale for field in goals])}\n"
    )


def _recorded_goals(logs: Logs) -> str:
    """Return what an objective says of goals that its data have; nothing without any."""
    if not (fields := logs.of("goal")):
        return ""
    goals = np.concatenate(logs.values(fields))
    low, high = numbers(goals.min(axis=0)), numbers(goals.max(axis=0))
    return (
        f"\n    goal_size = {len(fields)}  # CHECK: {GOAL} of the data, which nothing below uses\n\n"
        "    def draw_goals(self, rng, count):  # CHECK: where goals were\n"
        f"        return rng.uniform({low}, {high}, (count, {len(fields)}))"
    )


def _toml(value: str | Sequence[str] | Sequence[float]) -> str:
    """Return a text, or a list, as TOML, which is also Python."""
    return json.dumps(value, ensure_ascii=False)


def _drive(folder: Path) -> None:
    """Record a made-up cart that lags behind its commands and tips over in fast turns."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    header = "t_s,x_m,y_m,heading_x,heading_y,v_m_s,w_rad_s,cmd_v_m_s,cmd_w_rad_s,tipped"
    for drive in range(60):
        x, y, yaw, v, w, left, tilt, rows = 0.0, 0.0, rng.uniform(-math.pi, math.pi), 0.0, 0.0, 0, 0.0, []
        for step in range(150):
            if left == 0:
                command, left = rng.uniform([-0.2, -1.5], [1.0, 1.5]), int(rng.integers(1, 21))
            left -= 1
            tilt += 0.3 * (v * w - tilt)
            rows.append([step / 10, x, y, math.cos(yaw), math.sin(yaw), v, w, *command, abs(tilt) > 0.7])
            if rows[-1][-1]:
                break
            v, w = np.array([v, w]) + 0.4 * (command - [v, w])
            x, y, yaw = x + 0.095 * v * math.cos(yaw), y + 0.095 * v * math.sin(yaw), yaw + 0.085 * w
        np.savetxt(folder / f"drive_{drive:02d}.csv", rows, "%.4f", ",", header=header, comments="")
