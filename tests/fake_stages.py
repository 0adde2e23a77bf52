"""Stages that make small artifacts at once, in this process, and note what they were given.

They stand in the registry of stages with the real signatures and settings, so a run of them is planned,
checked and judged as any other.
"""

import inspect
import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fake_dataset import DESCRIPTION, fake_episode, writer

from astra_data.core.artifact import finished_folder
from astra_data.core.durable import file_digest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.dataset.description import read_description
from astra_data.pipeline.executors import EXECUTORS, Item, Watch
from astra_data.pipeline.plan import ARTIFACTS
from astra_data.pipeline.stages.registry import STAGES, Stage


class FakeStages:
    """What was made in which order, with what; keys in `failing` fail once they are half done."""

    def __init__(self) -> None:
        self.made: list[str] = []
        self.asked: dict[str, dict[str, Any]] = {}
        self.failing: set[str] = set()

    def run_here(self, items: Collection[Item], *, watch: Watch, prepare: Callable[[], object], **_: object) -> None:
        """Run items as an executor does, one after another."""
        for item in items:
            watch(item.key, None)
            try:
                item.call(progress=lambda share, note, key=item.key: watch(key, (share, note)))
            except AstraDataError as error:
                watch(item.key, error)
                raise type(error)(f"{item.key}: {error}") from None
            watch(item.key, 1.0)


class _Fake:
    def __init__(self, stage: Stage, runs: FakeStages) -> None:
        self.stage, self.runs = stage, runs
        self.__signature__ = inspect.signature(stage.run)

    def __call__(self, *first: Any, progress: Callable[[float, str], object], **given: Any) -> None:
        out: Path = given.get("out") or given["root"] / self.stage.name
        root = next((place for place in out.parents if place.name == self.stage.name), out).parent
        key = out.relative_to(root).as_posix()
        self.runs.made.append(key)
        self.runs.asked[key] = given | ({"recipe": first[0]} if first else {})
        begun = out.with_name(f".{out.name}.partial")
        progress(0.5, "half")
        if key in self.runs.failing:
            begun.mkdir(parents=True, exist_ok=True)
            (begun / "checkpoint").touch()
            raise BadInputError("told to fail")
        read = {name: digest(Path(given[name])) for name in ARTIFACTS if given.get(name)}
        if self.stage.makes_dataset:
            parents = [{"name": "fake", "version": "1.0.0", "hash": one} for one in read.values()]
            seed = int(out.name.removeprefix("seed_"))
            told = {"name": f"{self.stage.name}_{seed}", "stage": self.stage.name, "parents": parents}
            with writer(out, description={**DESCRIPTION, **told}) as dataset:
                dataset.add(fake_episode(seed, 4))
            return
        if self.stage.each == "recipe":
            stages = ("train", "ground") if self.stage.name == "select" else ("evaluate", "select")
            places = [place for stage in stages for place in sorted((root / stage).glob("**/seed_*"))]
            places += [root / "select"] if "select" in stages and (root / "select").is_dir() else []
            read = {place.relative_to(root).as_posix(): digest(place) for place in places}
        with finished_folder(out, replace=self.stage.each == "recipe", made_from=read) as folder:
            result = f"{key} {json.dumps(read)}"
            (folder / (self.stage.result or "results.json")).write_text(
                json.dumps(evaluation(given)) if self.stage.name == "evaluate" else result
            )
            if self.stage.name in ("ground", "align", "train"):
                name = "curve.json" if self.stage.name == "train" else "metrics.json"
                (folder / name).write_text('{"wall_seconds": 2.0}')


def evaluation(given: dict[str, Any]) -> dict[str, Any]:
    outcomes = {name: [0.0, 1.0] for name in ("success", "failed", "wall_contact")}
    outcomes |= {"steps": [10.0, 30.0], "return": [2.0, 3.0]}
    return {
        **{name: given[name] for name in ("task", "method", "seed")},
        "episodes": 2,
        "dataset_version": "fake@data-1.0.0",
        "dataset_hash": f"hash{given['seed']}",
        "git_commit": "abc",
        "wall_seconds": 3.0,
        "target": outcomes | {"success": [float(given["seed"] > 0), 1.0]},
        "simulated": outcomes if given.get("policy") else None,
    }


def digest(folder: Path) -> str:
    """Return by what later artifacts name the one in a folder."""
    names = [stage.result for stage in STAGES.values() if stage.result]
    file = next((path for name in names if (path := folder / name).is_file()), None)
    return file_digest(file) if file else str(read_description(folder)["content_hash"])


@contextmanager
def fake_stages() -> Iterator[FakeStages]:
    """Let every run of this process be one of such stages."""
    runs = FakeStages()
    stages = {name: replace(stage, run=_Fake(stage, runs)) for name, stage in STAGES.items()}
    executors = {"processes": runs.run_here}
    with patch.dict(STAGES, stages), patch.dict(EXECUTORS, executors):
        yield runs
