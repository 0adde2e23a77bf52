"""Processes that want to make the same folders."""

from contextlib import suppress
from pathlib import Path

from astra_data.core.durable import atomic_folder
from astra_data.core.errors import BadInputError

ROUNDS = 60


def race(root: Path) -> None:
    for number in range(ROUNDS):
        with suppress(BadInputError), atomic_folder(root / str(number)) as folder:
            (folder / "some").touch()
