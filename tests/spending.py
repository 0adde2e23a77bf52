"""Checkpoints that tell of a long time before an interruption."""

from pathlib import Path

from astra_data.core.checkpoint import load_tensors, save_tensors

SPENT = {"wall_seconds": 1000.0, "cpu_seconds": 2000.0}


def spend(checkpoint: Path) -> None:
    """Have `checkpoint` tell that everything up to it took `SPENT`."""
    tensors, told = load_tensors(checkpoint)
    assert told["spent"].keys() >= SPENT.keys()
    save_tensors(checkpoint, tensors, told | {"spent": told["spent"] | SPENT})
