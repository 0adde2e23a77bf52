"""Checkpoints that tell of a long time before an interruption."""

from pathlib import Path

from astra_data.core.checkpoint import resumed, save_state

SPENT = {"wall_seconds": 1000.0, "cpu_seconds": 2000.0}


def spend(checkpoint: Path) -> None:
    """Have `checkpoint` tell that everything up to it took `SPENT`."""
    with resumed(checkpoint) as (state, told):
        assert told["spent"].keys() >= SPENT.keys()
        save_state(checkpoint, state, told | {"spent": told["spent"] | SPENT})
