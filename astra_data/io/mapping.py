"""The mapping of a recording's fields to columns, a TOML file."""

import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from astra_data.core.config import Config, Count, Positive, load_tables, validated
from astra_data.core.errors import RecipeError
from astra_data.dataset.columns import DONE, RESERVED, REWARD, STATE, SUCCESS, TERMINATED, TRUNCATED
from astra_data.dataset.lerobot_recording import FLOATS

Index = Annotated[int, Field(ge=0)]


def _other_than_zero(factor: float) -> float:
    if factor == 0:
        raise ValueError("expected a factor other than 0, which would make all values equal")
    return factor


Factor = Annotated[float, AfterValidator(_other_than_zero)]
MAPPED_FLAGS = (TERMINATED, TRUNCATED, SUCCESS)
_OF_RECIPES = {"methods", "based_on"}  # keys that recipes have, and no mapping


class ColumnMapping(Config):
    """Where one column comes from.

    The fields are concatenated; each row of a field with more than two dimensions is flattened. Then `take`, `scale`,
    `offset` and `clip` are applied, in this order. A list with one entry applies to every value.
    """

    fields: Annotated[tuple[str, ...], Field(min_length=1)]
    """Fields of the source; for MCAP "/topic:path.in.message", or "/topic:list[name]" for named values; for
    several CSV files of one recording, which are joined by `time`, "state.csv:field"."""
    take: tuple[Index, ...] = ()
    """Indices of the values to use, from 0; by default all."""
    scale: tuple[Factor, ...] = ()
    """Factors other than 0, such as 0.001 for mm."""
    offset: tuple[float, ...] = ()
    """Added after scaling."""
    clip: tuple[float, float] | None = None
    """Range to clip values to; values that are not finite are rejected, not clipped."""
    names: tuple[str, ...] = ()
    """A name for each value; by default the fields' names, if each field has one value."""
    unit: tuple[str, ...] = ()
    """Units after scaling."""
    frame: tuple[str, ...] = ()
    """Frames of reference."""
    role: tuple[str, ...] = ()
    """How a planar rotation transforms each value: see `columns.ROLES`."""
    meaning: str = ""
    """One sentence that describes the column."""
    dtype: Literal["float32", "int64", "bool"] | None = None
    """By default bool for flags and float32 for everything else."""
    latched: bool = False
    """MCAP: published once or on change, so that the last value holds without limit."""
    gap_s: Positive | None = None
    """MCAP: the longest time that the last value of this column's topics is held; by default that of `split`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        key, labels = ("names", self.names) if self.names or self.take else ("fields", self.fields)
        if doubled := sorted({name for name in labels if labels.count(name) > 1}):
            raise ValueError(f"{key} has {', '.join(doubled)} more than once")
        if self.latched and self.gap_s is not None:
            raise ValueError("latched holds without limit, and gap_s is a limit: leave one out")
        if self.clip is not None and self.clip[0] >= self.clip[1]:
            raise ValueError(f"clip {list(self.clip)}, expected the lower bound first")
        return self


class Jump(Config):
    """Where a jump begins a new episode."""

    column: str
    """Column that jumps."""
    values: Annotated[tuple[Index, ...], Field(min_length=1)]
    """Which of its values, such as x and y."""
    above: Positive
    """Euclidean distance between rows, in the column's unit, above which it is a jump; full turns of an angle
    do not count."""


class Split(Config):
    """Conditions that begin a new episode, in addition to the episodes that a format itself has."""

    files: bool = True
    """Each file. If false, the files of a folder or archive continue one another (not for MCAP)."""
    field: str | None = None
    """A field of the source: a new value begins an episode."""
    ends: tuple[str, ...] = ()
    """Fields of the source that are true in the last row of an episode, in addition to those of
    next.terminated and next.truncated."""
    gap_s: Positive | None = None
    """A longer step in `time`; for MCAP, the longest time that a topic's last value is held. Time that goes
    back within a file always begins a new episode; for MCAP, if a topic goes back by more than this."""
    jump: Jump | None = None
    """A jump between rows."""


class ImportMapping(Config):
    """How a recording becomes a dataset."""

    name: str
    """The dataset's name."""
    task: str
    """What the robot does in the episodes: a sentence or a name."""
    fps: Count
    """Steps per second. MCAP is resampled to it by holding each value until the next; in other formats, each
    row is a step."""
    columns: Annotated[dict[str, ColumnMapping], Field(min_length=1)]
    """Columns by name. If next.observation.state is left out, it is derived: an episode then loses its last
    row, whose next state was not recorded (see `terminal`). A row with next.terminated or next.truncated ends
    its episode, even if the flag stays set in later rows. next.done is always derived."""
    version: str = "1.0.0"
    """The dataset's version."""
    format: str | None = None
    """One of `importing.FORMATS`, by default inferred from the file's name."""
    split: Split = Split()
    """What begins a new episode."""
    time: str | None = None
    """Field with the time of each row; the rate measured from it must equal `fps`."""
    time_scale: Positive = 1.0
    """Seconds per unit of `time`."""
    not_finite: Literal["refuse", "drop", "split"] = "refuse"
    """What to do with rows whose values are not finite. "refuse": nothing is imported. "drop": they are left
    out, and their neighbors become consecutive. "split": they are left out and begin new episodes."""
    terminal: Literal["drop", "stand_still"] = "drop"
    """What to do with a terminated last row whose next state was not recorded. "drop": it is left out, and
    its next.terminated, next.success and next.reward go to the step before, which led to it. "stand_still":
    it is kept, with its own state as the (made-up) next state."""
    min_steps: Count = 1
    """Episodes with fewer steps are left out."""
    episodes: str | None = None
    """HDF5: groups that are episodes, such as "data/demo_*"; fields are then relative to the group. Or
    "{field}_{number}", if the names of fields end with the number of the episode, as in d3rlpy's files; a
    single value then belongs to the last row."""
    stacked: bool | None = None
    """Whether fields are (episodes, steps, ...), as batches for learning are; where they may be, it has to be given."""
    transposed: bool = False
    """HDF5: rows lie along the last dimension, as in MATLAB's files."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        faults = []
        for name, column in self.columns.items():
            expected = "bool" if name in MAPPED_FLAGS else "float32" if name in FLOATS else column.dtype
            if column.dtype not in (None, expected):
                faults.append(f"column {name} has dtype {column.dtype}, expected {expected}")
            if name in (*RESERVED, DONE):
                faults.append(f"column {name} is filled in, leave it out")
            slip = get_close_matches(name, {*MAPPED_FLAGS, *FLOATS} - self.columns.keys(), n=1, cutoff=0.9)
            if slip and name not in (*MAPPED_FLAGS, *FLOATS):
                faults.append(f"column {name}: did you mean '{slip[0]}'?")
        jump = self.split.jump
        if jump is not None and jump.column not in self.columns:
            faults.append(f"split.jump.column '{jump.column}', expected one of {', '.join(self.columns)}")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def refuse_timeless(self, file_format: str, origin: str) -> None:
        """Raise RecipeError where keys of the mapping `origin` say what `time` means, but there is none."""
        of_columns = [f'columns."{name}".gap_s' for name, column in self.columns.items() if column.gap_s]
        if of_columns and file_format != "mcap":
            raise RecipeError(f"{origin}: {', '.join(of_columns)}: only MCAP has it, take split.gap_s")
        given = {"split.gap_s": self.split.gap_s is not None, "time_scale": self.time_scale != 1.0}
        if self.time is None and file_format != "mcap" and any(given.values()):
            keys = " and ".join(key for key, is_given in given.items() if is_given)
            raise RecipeError(f"{origin}: {keys} without `time`: set time to the field with the times")

    @property
    def fields(self) -> list[str]:
        """The fields with numbers that the mapping needs, each once."""
        more = [*self.split.ends, *([self.time] if self.time else [])]
        return list(dict.fromkeys([field for c in self.columns.values() for field in c.fields] + more))

    @property
    def files(self) -> list[str]:
        """The CSV files that fields such as "control.csv:rudder" are of, that of the state first."""
        first = self.columns[STATE].fields if STATE in self.columns else ()
        found = [re.match(r"(.+\.[ct]sv):.", field) for field in (*first, *self.all_fields)]
        return list(dict.fromkeys(match[1] for match in found if match))

    @property
    def flag_fields(self) -> list[str]:
        """The fields of flags, outcomes and ends of episodes."""
        fields = [*self.split.ends, *([self.split.field] if self.split.field else [])]
        for name, column in self.columns.items():
            fields += column.fields if column.dtype == "bool" or name in (*MAPPED_FLAGS, REWARD) else ()
        return fields

    @property
    def all_fields(self) -> list[str]:
        """The fields that the mapping needs, with the one that separates episodes."""
        return list(dict.fromkeys([*self.fields, *([self.split.field] if self.split.field else [])]))


def refuse_mapping(tables: Mapping[str, Any], path: Path) -> None:
    """Raise RecipeError where `tables`, of the file `path` that was given as a recipe, are a mapping."""
    if "columns" in tables and not _OF_RECIPES & tables.keys():
        raise RecipeError(f"{path} is a mapping: `astra-data import LOGS --mapping {path}`")


def read_mapping(path: Path) -> ImportMapping:
    """Read the mapping in the file `path`, or raise a RecipeError with all of its faults."""
    tables = load_tables(path)
    if "columns" not in tables and _OF_RECIPES & tables.keys():
        expected = "expected a mapping, which `astra-data new` writes"
        raise RecipeError(f"{path} is a recipe: `astra-data run {path}`; {expected}")
    return validated(tables, ImportMapping, str(path))
