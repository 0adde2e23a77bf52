"""The CSV logs that `new` begins with, and what is said of a place that holds none."""

import shlex
from pathlib import Path

from astra_data.core.errors import BadInputError
from astra_data.dataset.opening import refuse_run, refuse_versions
from astra_data.exchange.importers.csv import SUFFIXES
from astra_data.exchange.importers.mcap import BAGS
from astra_data.exchange.recording import refuse_dataset


def csv_files(place: Path) -> list[Path]:
    """Return the CSV files in a folder, or the one that `place` is.

    Raises:
        BadInputError: there is none; says what is there instead, and what to do.
    """
    if not place.exists():
        raise BadInputError(f"{place}: no such file, folder or dataset")
    inside = sorted(place.iterdir()) if place.is_dir() else [place]
    if found := [path for path in inside if path.suffix.lower() in SUFFIXES]:
        return found
    refuse_versions(place)
    refuse_dataset(place)
    refuse_run(place)
    files = [*inside, *sorted(place.glob("*/*"))]  # a bag is a folder itself
    if bags := [path.name for path in files if path.name.lower().endswith(BAGS)]:
        raise BadInputError(
            f"{place}: expected CSV logs or a dataset, got a ROS recording, {bags[0]}: make it a dataset "
            f"(`astra-data import {shlex.quote(str(place))} --mapping recipes/imports/ros2_base.toml`, "
            "with that mapping or one like it: `astra-data recipes copy ros2_base`), then name the "
            "dataset: --from NAME"
        )
    raise BadInputError(
        f"{place}: expected files that end in {' or '.join(SUFFIXES)}, found none: convert other formats "
        "with `import` and a mapping, then give `new` the dataset"
    )
