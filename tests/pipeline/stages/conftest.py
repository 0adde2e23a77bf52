"""The artifacts of one small run, each made once."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_run import ALIGN, COLLECT, GROUND, TASK, TRAIN, short_task

from astra_data.core.artifact import write_manifest
from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.progress import silent
from astra_data.pipeline.stages.align import align
from astra_data.pipeline.stages.collect import collect
from astra_data.pipeline.stages.ground import ground
from astra_data.pipeline.stages.pair import PairConfig, pair
from astra_data.pipeline.stages.train import train


@pytest.fixture
def task() -> Iterator[str]:
    with short_task():
        yield TASK


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("stages") / "collect"
    with short_task():
        collect(TASK, COLLECT, seed=0, out=out, progress=silent)
    return out


@pytest.fixture(scope="session")
def paired(collected: Path) -> Path:
    out = collected.with_name("pair")
    with short_task():
        pair(TASK, PairConfig(), dataset=collected, out=out, progress=silent)
    return out


@pytest.fixture(scope="session")
def grounded(paired: Path) -> Path:
    out = paired.with_name("ground")
    with short_task():
        ground(TASK, "astra", GROUND, dataset=paired, seed=0, out=out, device="cpu", progress=silent)
    return out


@pytest.fixture(scope="session")
def grounded_anew(grounded: Path, paired: Path) -> Path:
    """A grounding with the same settings and other weights."""
    out = paired.with_name("ground_anew")
    shutil.copytree(grounded, out)
    tensors, told = load_tensors(out / "grounding.safetensors")
    save_tensors(out / "grounding.safetensors", {name: value * 0.5 for name, value in tensors.items()}, told)
    write_manifest(out, {})
    return out


@pytest.fixture(scope="session")
def trained(grounded: Path, paired: Path) -> Path:
    out = paired.with_name("train")
    inputs = {"dataset": paired, "grounding": grounded}
    with short_task():
        train(TASK, "astra", TRAIN, **inputs, seed=0, out=out, device="cpu", progress=silent)  # type: ignore[arg-type]
    return out


@pytest.fixture(scope="session")
def aligned(grounded: Path, paired: Path) -> Path:
    out = paired.with_name("align")
    inputs = {"dataset": paired, "grounding": grounded}
    align(ALIGN, **inputs, seed=0, out=out, device="cpu", progress=silent)
    return out
