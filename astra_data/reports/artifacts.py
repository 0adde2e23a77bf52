"""Files that the other stages write: a missing key is an error, an extra one is not."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from astra_data.core.arrays import Floats
from astra_data.core.artifact import check_intact
from astra_data.core.config import read_written
from astra_data.core.errors import BadInputError

EVALUATION = "evaluation.json"
TRAJECTORIES = "trajectories.safetensors"
CURVE = "curve.json"
METRICS = "metrics.json"
GAP = "gap.json"


class WrittenPart(BaseModel):
    """A part of a file that a stage wrote."""

    model_config = ConfigDict(frozen=True)


class Machine(WrittenPart):
    """The machine that a stage ran on; `gpu` is None where the networks ran on the CPU."""

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None = None


class Artifact(WrittenPart):
    """A file that a stage wrote, with its times (in s; its end since 1970) and, if recorded, its origin."""

    wall_seconds: float | None = None
    cpu_seconds: float | None = None
    finished_at: float | None = None
    git_commit: str | None = None
    packages: dict[str, str | None] = Field(default_factory=dict)
    machine: Machine | None = None

    def numbers(self) -> dict[str, float | None]:
        """Return what the stage recorded of itself, as `Results.lines` hold it: its times."""
        return {name: getattr(self, name) for name in ("wall_seconds", "cpu_seconds", "finished_at")}


class Outcomes(WrittenPart, extra="allow"):
    """Outcomes of a policy's episodes, one number per episode; further measures are kept as they are."""

    __pydantic_extra__: dict[str, list[float]]

    success: list[float]
    failed: list[float]
    wall_contact: list[float]
    steps: list[float]
    returns: list[float] = Field(alias="return")

    def means(self) -> dict[str, float]:
        """Return the mean of each measure over the episodes, by its name in the file."""
        return {name: float(np.mean(values)) for name, values in self.model_dump(by_alias=True).items()}


class Evaluation(Artifact):
    """evaluation.json of one row and seed."""

    task: str
    method: str
    seed: int
    episodes: int = Field(ge=1)
    leg_scale: float = 1.0
    dataset_version: str | None = None
    dataset_hash: str | None = None
    tested_in: Literal["target", "grounded", "raw"] = "target"  # a simulator, if the task has no target
    target: Outcomes | None = None
    simulated: Outcomes | None = None  # in the simulator that the policy was trained in; None if it was trained in none
    raw: Outcomes | None = None  # in the raw simulator; None for a policy that cannot act on abstract states
    grounded: Outcomes | None = None  # in the reference grounded simulator; None if there is none, or likewise
    beyond_recorded: float | None = None  # share of tested steps whose command is beyond the dataset's range
    encoder: str | None = None  # which one its figures in the target are of; None for a hand-written row
    encoders: dict[str, dict[str, float]] = Field(default_factory=dict)  # mean of each measure, if there are several

    @property
    def outcomes(self) -> Outcomes:
        """The outcomes where the row was tested."""
        found: Outcomes = getattr(self, self.tested_in)
        return found


class CurvePoint(WrittenPart):
    """One point of a learning curve: success and mean length in steps of the episodes that ended, if any."""

    steps: float
    success: float | None
    episode_steps: float | None = None


class CurveFile(Artifact):
    """curve.json of one row and seed."""

    points: list[CurvePoint] = Field(min_length=1)
    tries: list[dict[str, JsonValue]] = Field(default_factory=list)
    """Of a training that may be done again: what each try reached; the points are those of the one kept."""

    def numbers(self) -> dict[str, float | None]:
        """Return times and the number of tries."""
        return {**super().numbers(), "tries": float(len(self.tries)) or None}


class Foresight(WrittenPart):
    """How well failures are predicted on held-out episodes; `reliability` is predicted and observed rate, and steps."""

    failures: int
    auc: dict[str, float | None] | None = None
    brier_skill: float | None = None
    reliability: list[tuple[float, float, int]] | None = None


class Metrics(Artifact, extra="allow", allow_inf_nan=False):
    """metrics.json of one row and seed's grounding or alignment; further figures are kept as they are."""

    __pydantic_extra__: dict[str, JsonValue]

    epochs: list[dict[str, JsonValue]] = Field(default_factory=list)
    """Losses and R² on held-out episodes during the fit; the last are those of the grounding."""
    failures: dict[str, Foresight] = Field(default_factory=dict)  # by what predicts them; empty without a failure model

    def numbers(self) -> dict[str, float | None]:
        """Return times, the last R² and, by dotted names, the figures of predicted failures."""
        last = self.epochs[-1] if self.epochs else {}
        explained = dict(_flat({name: value for name, value in last.items() if name.startswith("r2_")}))
        return super().numbers() | explained | dict(_flat(self.model_dump(include={"failures"})))


def _flat(values: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers in nested mappings and lists by their dotted names."""
    if isinstance(values, list | tuple):
        values = dict(enumerate(values))
    if isinstance(values, Mapping):
        for key, value in values.items():
            yield from _flat(value, f"{name}.{key}" if name else f"{key}")
    elif values is not None:
        yield name, float(values)  # type: ignore[arg-type]


class Band(WrittenPart):
    """An error at each horizon; no interval where a single episode is that long."""

    mean: list[float]
    low: list[float | None]
    high: list[float | None]


class Gap(Artifact):
    """gap.json: open-loop error by horizon in steps, for each quantity; `still` is that of the persistence baseline."""

    horizons: list[int]
    grounded: dict[str, Band]
    raw: dict[str, Band]
    still: dict[str, Band] | None = None


class DatasetFile(Artifact):
    """meta/astra/dataset.json of a dataset."""

    name: str
    version: str
    content_hash: str


def read_json[T: WrittenPart](model: type[T], path: Path) -> T:
    """Read one of the files above; raise a BadInputError if it was altered or its stage wrote another."""
    check_intact(path)
    return read_written(model, path, by="its stage", advice="run that stage again")


def found_json[T: WrittenPart](model: type[T], path: Path) -> T | None:
    """Read one of them where it is there, else return None."""
    return read_json(model, path) if path.is_file() else None


def read_tensors(path: Path, names: tuple[str, ...]) -> dict[str, Floats]:
    """Read a safetensors file that holds at least `names`, or raise a BadInputError."""
    from astra_data.core.checkpoint import load_tensors  # noqa: PLC0415 - figures of datasets do without torch

    tensors, _ = load_tensors(path)
    if missing := [name for name in names if name not in tensors]:
        raise BadInputError(f"{path}: expected tensors {missing}, got {sorted(tensors)}; run its stage again")
    return {name: tensor.double().numpy() for name, tensor in tensors.items()}


def way_to_success(path: Path, evaluation: Evaluation) -> float:
    """Return the robot's mean path length in m over the successful episodes at `path`; NaN without any."""
    tested = f"{evaluation.tested_in}.position"
    robot = read_tensors(path, (tested,))[tested][..., :2]
    ways = np.nansum(np.linalg.norm(np.diff(robot, axis=1), axis=-1), axis=1)
    succeeded = ways[np.array(evaluation.outcomes.success, dtype=bool)]
    return float(succeeded.mean()) if len(succeeded) else float("nan")
