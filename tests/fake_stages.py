"""Stages with the real signatures that only write down what they were asked.

Spawned processes find them by name; nothing slow is imported.
"""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from astra_data.core.artifact import write_manifest
from astra_data.core.config import Config
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.core.progress import Progress


@dataclass(frozen=True)
class Reported:
    name: str
    task: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: Mapping[str, Any]
    percents: tuple[int, ...]


class FakeConfig(Config):
    steps: int = 1
    rate: float = 0.5
    fails: bool = False
    learner: str = "ppo"
    held_out_share: float = 0.1


class FakeCollectConfig(FakeConfig):
    episodes: int = 200
    behavior: str = "random"


class FakeSelectConfig(FakeConfig):
    judge: str | None = None


CONFIGS: dict[str, Any] = dict.fromkeys(
    ("augment", "pair", "ground", "train", "align", "evaluate", "report"), FakeConfig
)
CONFIGS["collect"] = FakeCollectConfig
CONFIGS["select"] = FakeSelectConfig
"""Models of the stages' tables."""


@dataclass(frozen=True)
class FakeTable:
    name: str


class FakeMethod:
    def __init__(
        self,
        grounds: bool,
        aligns: bool,
        trains: bool,
        grounded_as: str = "",
        initial: str | None = None,
        steps_target: bool = False,
        table: FakeTable | None = None,
    ) -> None:
        self.grounds, self.aligns, self.trains = grounds, aligns, trains
        self.in_simulator = trains and initial is None and not steps_target
        self.trains_without_target = trains and not steps_target
        self.steps_target, self.table, self.configures = steps_target, table, "train"
        self.grounded_as, self.initial = grounded_as, initial


METHODS = {
    "follower": FakeMethod(grounds=False, aligns=False, trains=False),
    "direct_transfer": FakeMethod(grounds=False, aligns=False, trains=True),
    "nas": FakeMethod(grounds=True, aligns=False, trains=True),
    "astra": FakeMethod(grounds=True, aligns=True, trains=True),
    "astra_again": FakeMethod(grounds=True, aligns=True, trains=True, grounded_as="astra"),
    "target": FakeMethod(
        grounds=False, aligns=False, trains=True, steps_target=True, table=FakeTable("target")
    ),
    "full_obs": FakeMethod(
        grounds=False, aligns=False, trains=True, steps_target=True, table=FakeTable("target")
    ),
    "fine_tuned": FakeMethod(grounds=False, aligns=False, trains=True, initial="direct_transfer"),
}


def _write(
    config: FakeConfig,
    out: Path,
    progress: Progress,
    files: Mapping[str, object] = MappingProxyType({}),
    **asked: Any,  # noqa: ANN401 - JSON
) -> None:
    folder = out.with_name(f".{out.name}.partial")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "attempts").open("a") as file:
        file.write(".")
    progress(0.5, "half")
    if config.fails:
        raise BadInputError("told to fail")
    (folder / "asked.json").write_text(json.dumps(asked | {"steps": config.steps}, default=str))
    for name, content in files.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    made_from = {name: _digest(Path(read)) for name, read in asked.items() if name in READ and read}
    stage = next(part for part in reversed(out.parts) if part in (*DATASETS, *RESULTS))
    if stage == "select":
        read = ("train/*/", "ground/*/", "pair/")
        folders = [path for pattern in read for path in sorted(out.parent.glob(f"{pattern}seed_*"))]
        made_from = {path.relative_to(out.parent).as_posix(): _digest(path) for path in folders}
    if stage == "report":
        read_files = [*out.parent.glob("evaluate/**/evaluation.json"), *out.parent.glob("select/select.json")]
        made_from = {str(file): file_digest(file) for file in read_files}
    if stage in DATASETS:
        parents = [{"hash": digest} for digest in made_from.values()]
        description = {"stage": stage, "content_hash": file_digest(folder / "asked.json"), "parents": parents}
        (folder / "dataset.json").write_text(json.dumps(description))
    else:
        (folder / RESULTS[stage]).touch()
        if stage != "evaluate":
            (folder / RESULTS[stage]).write_text(f"the result of {out}")
        write_manifest(folder, made_from)
    os.replace(folder, out)


DATASETS = ("collect", "label", "augment", "pair", "subset")
RESULTS = {
    "ground": "grounding.safetensors",
    "train": "policy.safetensors",
    "align": "target_encoder.safetensors",
    "select": "select.json",
    "evaluate": "evaluation.json",
    "report": "results.json",
}
READ = ("dataset", "policy", "grounding", "target_encoder", "reference", "initial")
"""Parameters that are folders of artifacts."""


def asked(folder: Path) -> dict[str, Any]:
    """Return what the stage that made `folder` was given."""
    return dict(json.loads((folder / "asked.json").read_text()))


def _digest(folder: Path) -> str:
    if (folder / "dataset.json").exists():
        return str(read_description(folder)["content_hash"])
    return file_digest(next(path for name in RESULTS.values() if (path := folder / name).exists()))


def read_description(root: Path) -> dict[str, Any]:
    """Read the description of a fake dataset, in place of `meta_files.read_description`."""
    try:
        description: dict[str, Any] = json.loads((root / "dataset.json").read_text())
    except (OSError, ValueError):
        raise CorruptDatasetError(f"{root} is incomplete") from None
    return description


class FakeDataset:
    """In place of `Dataset`; a file `altered` in its folder stands for altered values."""

    root: Path

    @classmethod
    def open(cls, root: Path) -> "FakeDataset":
        read_description(root)
        opened = cls()
        opened.root = root
        return opened

    def verify(self) -> list[str]:
        return ["a value was altered"] if (self.root / "altered").exists() else []


def prepare(own_methods: Mapping[str, Any]) -> None:
    """Leave out what takes the processes of a run long: to import torch."""


def collect(
    task: str, config: FakeCollectConfig, *, seed: int, out: Path, progress: Progress, num_threads: int
) -> None:
    _write(config, out, progress, task=task, seed=seed, episodes=config.episodes, num_threads=num_threads)


def label(task: str, *, data: str, seed: int, out: Path, progress: Progress) -> None:
    _write(FakeConfig(), out, progress, task=task, data=data, seed=seed)


def augment(
    task: str, config: FakeConfig, *, dataset: Path, seed: int, out: Path, progress: Progress
) -> None:
    _write(config, out, progress, task=task, dataset=dataset, seed=seed)


def pair(task: str, config: FakeConfig, *, dataset: Path, out: Path, progress: Progress) -> None:
    _write(config, out, progress, task=task, dataset=dataset)


def subset(dataset: Path, *, percent: int, of: int | None, out: Path, progress: Progress) -> None:
    _write(FakeConfig(), out, progress, dataset=dataset, percent=percent, of=of)


def ground(
    task: str,
    method: str,
    config: FakeConfig,
    *,
    settings: Config | None,
    dataset: Path,
    seed: int,
    out: Path,
    device: str,
    progress: Progress,
) -> None:
    asked = {"settings": settings, "dataset": dataset, "seed": seed, "device": device}
    _write(config, out, progress, {"metrics": {"wall_seconds": 1.5}}, task=task, method=method, **asked)


def train(
    task: str,
    method: str,
    config: FakeConfig,
    *,
    settings: Config | None,
    dataset: Path,
    grounding: Path | None,
    initial: Path | None,
    seed: int,
    out: Path,
    device: str,
    progress: Progress,
    num_threads: int | None = None,
) -> None:
    asked: dict[str, object] = {"dataset": dataset, "grounding": grounding, "initial": initial, "seed": seed}
    if num_threads:
        asked |= {"num_threads": num_threads, "settings": settings}
    _write(config, out, progress, {"curve": {"wall_seconds": 20.0}}, task=task, method=method, **asked)


def align(
    config: FakeConfig,
    *,
    dataset: Path,
    grounding: Path,
    seed: int,
    out: Path,
    device: str,
    progress: Progress,
) -> None:
    asked = {"dataset": dataset, "grounding": grounding, "seed": seed}
    _write(config, out, progress, {"metrics": {"wall_seconds": 0.25}}, **asked)


def evaluate(
    task: str,
    method: str,
    config: FakeConfig,
    *,
    policy: Path | None,
    grounding: Path | None,
    target_encoder: Path | None,
    reference: Path | None,
    recorded: Path | None,
    seed: int,
    out: Path,
    progress: Progress,
    num_threads: int,
) -> None:
    asked: dict[str, Any] = {"policy": policy, "grounding": grounding, "target_encoder": target_encoder}
    asked |= {
        "reference": reference,
        "task": task,
        "method": method,
        "seed": seed,
        "num_threads": num_threads,
    }
    outcomes = {name: [0.0, 1.0] for name in ("success", "failed", "wall_contact")}
    outcomes |= {"steps": [10.0, 30.0], "return": [2.0, 3.0]}
    evaluation = {
        "task": task,
        "method": method,
        "seed": seed,
        "episodes": 2,
        "dataset_version": "fake@data-1.0.0",
        "dataset_hash": f"hash{seed}",
        "git_commit": "abc",
        "wall_seconds": 3.0,
        "target": outcomes | {"success": [float(seed), 1.0]},
        "simulated": None if policy is None else outcomes,
    }
    _write(config, out, progress, {"evaluation": evaluation}, **asked)


def select(recipe: Reported, config: FakeConfig, *, root: Path, progress: Progress) -> None:
    _write(config, root / "select", progress, name=recipe.name, methods=recipe.methods, seeds=recipe.seeds)


def report(
    recipe: Reported,
    *,
    root: Path,
    command: str,
    publish: Path | None,
    published: Sequence[Path],
    progress: Progress,
    config: FakeConfig,
) -> None:
    asked: dict[str, Any] = {"name": recipe.name, "methods": recipe.methods, "seeds": recipe.seeds}
    asked |= {"command": command, "publish": publish, "published": list(published)}
    shutil.rmtree(root / "report", ignore_errors=True)
    _write(config, root / "report", progress, **asked)
