"""What the stages of a small recipe left behind, with numbers that can be worked out by hand."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save_file

from astra_data.core.naming import artifact_key
from astra_data.reports.results import TESTED, Line, Results
from astra_data.reports.runs import Reported

ROWS = ("direct_transfer", "astra", "astra_plus", "follower")
SEEDS = (0, 1, 2)
SUCCESS = {
    "direct_transfer": ([1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]),
    "astra": ([1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0]),
    "astra_plus": ([1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 1]),
    "follower": ([1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]),
}
"""Row → seed → episode."""

MADE = {
    "git_commit": "abc-dirty",
    "packages": {"torch": "2.0.0"},
    "machine": {"cpu": "Fast", "cores": 8, "memory_gib": 16.0, "gpu": "H200"},
}


@dataclass(frozen=True)
class FakeRecipe(Reported):
    name: str = "antmaze_u"
    task: str = "antmaze-u"
    methods: tuple[str, ...] = ROWS
    seeds: tuple[int, ...] = SEEDS
    settings: Mapping[str, Any] = field(default_factory=dict)
    percents: tuple[int, ...] = ()


def write_json(path: Path, values: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def edit_json(path: Path, **changes: object) -> None:
    write_json(path, json.loads(path.read_text()) | changes)


def outcomes(success: list[int], seed: int) -> dict[str, list[float]]:
    count = len(success)
    return {
        "success": [float(value) for value in success],
        "failed": [1.0 - value for value in success],
        "wall_contact": [0.1 * (seed + 1)] * count,
        "steps": [100.0 + 10 * episode for episode in range(count)],
        "return": [float(seed)] * count,
    }


def write_evaluation(root: Path, method: str, seed: int, percent: int | None = None, *, name: str = "") -> None:
    folder = root / artifact_key("evaluate", name or method, seed, percent)
    values: dict[str, object] = {
        "task": "antmaze-u",
        "method": name or method,
        "seed": seed,
        "episodes": 4,
        "dataset_version": None if method == "follower" else "antmaze-u-random@data-1.0.0",
        "dataset_hash": None if method == "follower" else f"hash{seed}",
        **MADE,
        "wall_seconds": 10.0,
        "cpu_seconds": 20.0,
        **({} if method == "follower" else {"encoder": "target"}),
        "target": outcomes(SUCCESS[method][seed], seed),
        "raw": outcomes([1, 1, 1, 1], seed) | {"return": [float(seed**2)] * 4},
    }
    if method != "follower":
        values["simulated"] = outcomes([1, 1, 1, 0], seed)
        values["grounded"] = outcomes([1, 1, 1, 1], seed) | {"return": [10.0 - seed] * 4}
    if method.startswith("astra"):
        values["encoders"] = {"target": {"success": 0.5}, "source": {"success": 0.1 * seed}}
    write_json(folder / "evaluation.json", values)
    positions = np.full((4, 6, 2), np.nan, dtype=np.float32)
    positions[:, :5] = np.linspace([-4, 4], [4, 4], 5)
    tensors = {"target.position": positions, "start": positions[:, 0].copy(), "goal": positions[:, 4].copy()}
    if method != "follower":
        tensors["simulated.position"] = positions
    save_file(tensors, folder / "trajectories.safetensors")


def band(error: float) -> dict[str, list[float]]:
    return {"mean": [error, 2 * error], "low": [error / 2, error], "high": [2 * error, float("nan")]}


def write_runs(parent: Path) -> Path:
    """Write the runs of a small recipe: ASTRA+ shares ASTRA's grounding, the follower learns nothing."""
    root = parent / "runs" / "antmaze_u"
    for seed in SEEDS:
        identity = {"name": "antmaze-u-random", "version": "data-1.0.0", "content_hash": f"hash{seed}"}
        write_json(root / f"collect/seed_{seed}/meta/astra/dataset.json", identity | MADE | {"wall_seconds": 5.0})
        write_json(root / f"pair/seed_{seed}/meta/astra/dataset.json", identity | MADE)
        ground = root / f"ground/astra/seed_{seed}"
        write_json(ground / "metrics.json", {"wall_seconds": 7.0, "cpu_seconds": 14.0} | MADE)
        grounded, raw = {"position_m": band(0.1 * (seed + 1))}, {"position_m": band(1.0)}
        write_json(ground / "gap.json", {"horizons": [1, 10], "grounded": grounded, "raw": raw})
        for method in ROWS:
            write_evaluation(root, method, seed)
            if method != "follower":
                points = [
                    {"steps": 0, "success": None, "entropy": 1.0},
                    {"steps": 1000, "success": 0.5, "entropy": 0.5},
                    {"steps": 2000, "success": 0.75, "entropy": 0.2},
                ]
                write_json(root / f"train/{method}/seed_{seed}/curve.json", MADE | {"points": points})
    return root


def write_choice(root: Path) -> None:
    """Write what the stage `select` predicts of ASTRA and ASTRA+; ASTRA+ is said to be the worse."""
    candidates = [
        {"row": row, "seed": seed, "percent": None, "success": {"7": share, "8": share, "9": share}}
        for row, shares in {"astra": (0.9, 0.8, 1.0), "astra_plus": (0.5, 0.25, 0.25)}.items()
        for seed, share in zip(SEEDS, shares, strict=True)
    ]
    values = {"judge": "astra", "episodes": 4, "shares_episodes": False, "candidates": candidates}
    write_json(root / "select/select.json", values | MADE | {"wall_seconds": 8.0})


def write_elsewhere(root: Path, name: str, like: str = "direct_transfer") -> None:
    """Add the row `name`, `like` another one, that was trained, but in no simulator."""
    for seed in SEEDS:
        write_evaluation(root, like, seed, name=name)
        path = root / f"evaluate/{name}/seed_{seed}/evaluation.json"
        values = json.loads(path.read_text())
        del values["simulated"]
        write_json(path, values)
        points = [{"steps": 1000, "success": None, "loss": 1.0}]
        write_json(root / f"train/{name}/seed_{seed}/curve.json", MADE | {"wall_seconds": 3.0, "points": points})


def line(row: str, seed: int, where: str = TESTED, percent: int = 100, **values: float) -> Line:
    return Line(row=row, seed=seed, percent=percent, where=where, values=values)


def results(*lines: Line, **changes: object) -> Results:
    """Return results that say hardly more than these lines."""
    rows = tuple(dict.fromkeys(one.row for one in lines))
    facts = {"recipe": "r", "task": "t", "command": "c", "rows": rows, "episodes": 4, "lines": lines}
    return Results.model_validate(facts | changes)
