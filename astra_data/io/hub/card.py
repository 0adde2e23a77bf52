"""A dataset's card, in the format of the Hugging Face Hub."""

import json
from collections.abc import Sequence
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from astra_data.core.config import Config
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.naming import in_code, in_markdown
from astra_data.dataset import format as layout
from astra_data.dataset.columns import RESERVED, STATE, Column
from astra_data.dataset.description import full_name
from astra_data.dataset.inspection import visited
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.stores import HubStore, parse_source
from astra_data.reports.blocks import table

TAGS = ("LeRobot", "robotics", "abstract-sim2real", "astra-data")

WIDE = 4  # columns with more values than this have their names listed below the table


class Notes(Config):
    """The part of a card that a person writes, a TOML file; every text is Markdown and optional."""

    license: Annotated[str, Field(min_length=1)] = "unknown"
    """One of the Hub's identifiers, such as "apache-2.0"."""
    summary: str = ""
    """What the dataset is; shown at the top of the card."""
    behavior: str = ""
    """Who or what acts in it, and how."""
    intended_use: str = ""
    """What it is meant for."""
    limits: str = ""
    """What it does not contain, and what it should not be used for."""


def write_card(dataset: Dataset, out: Path, notes: Notes, *, source: str | None = None) -> list[Path]:
    """Write the card of a verified `dataset`, shared at `source`, and its figure; refuse an `out` of other contents."""
    positions = visited(dataset)
    figure = None if positions is None else out.with_name(f"{out.stem}-coverage.png")
    text = render_card(dataset, notes, source=source, figure=figure.name if figure else None)
    if out.exists() and out.read_bytes() != text.encode():
        raise BadInputError(f"{out} exists already and is not this card; delete it or choose another file.")
    files: dict[Path, str | bytes] = {out: text}
    if positions is not None and figure is not None:
        from astra_data.reports.figures.style import coverage, png  # noqa: PLC0415 - slow

        files[figure] = png(coverage(positions.counts, positions.extent, "position", "m"))
    for path, content in files.items():
        write_file(path, content)
    return [*files]


def render_card(dataset: Dataset, notes: Notes, *, source: str | None = None, figure: str | None = None) -> str:
    """Return the card of `dataset` as Markdown with the Hub's front matter; `figure` is a path beside it."""
    from huggingface_hub import DatasetCardData  # noqa: PLC0415 - slow to import

    description = dataset.description
    name, tag = description["name"], f"data-{description['version']}"
    data = DatasetCardData(
        license=notes.license,
        pretty_name=name,
        task_categories=["robotics"],
        tags=list(TAGS),
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    place = None if source is None else parse_source(source)[0]
    root = "" if isinstance(place, HubStore) else f'root = "datasets/{name}/{tag}"\n'
    lerobot, rows = f'"{name}", root=root', '"parquet", data_files=f"{root}/data/*/*.parquet", split="train"'
    if isinstance(place, HubStore):
        lerobot = f'"{place.repo}", revision="{tag}"'
        rows = f'{lerobot}, split="train"'
    by_hand = {"Behavior": notes.behavior, "Intended use": notes.intended_use, "Limits": notes.limits}
    template = files("astra_data.io.hub").joinpath("card.md.template").read_text(encoding="utf-8")
    return template.format(
        front=data.to_yaml(),
        name=name,
        summary=f"{notes.summary.strip()}\n\n" if notes.summary else "",
        opening=_opening(dataset),
        picture=f"![Steps per cell of the plane]({figure})\n\n" if figure else "",
        fetch=f"```sh\nastra-data pull {source} --version {tag[5:]}\n```\n\n" if source else "",
        reference=dataset.reference,
        column=json.dumps(STATE if STATE in dataset.features else dataset.schema[0].name),
        root=root,
        lerobot=f"LeRobotDataset({lerobot})",
        rows=f"load_dataset({rows})",
        notes="".join(f"## {title}\n\n{text.strip()}\n\n" for title, text in by_hand.items() if text),
        counts=_counts(dataset),
        columns=_columns(dataset),
        provenance=_provenance(description),
    )


def _opening(dataset: Dataset) -> str:
    stand_in = dataset.description["environment"].get("stand_in")
    note = f" The robot is a simulated stand-in ({in_code(str(stand_in))}) for a physical one." if stand_in else ""
    size = f"{len(dataset):,} episodes, {int(dataset.lengths.sum()):,} steps at {dataset.info['fps']} Hz"
    task = f"Task: “{in_markdown(dataset.task)}”. The format is LeRobot {layout.CODEBASE_VERSION}."
    return f"Version {dataset.description['version']}: {size}. {task}{note}"


def _counts(dataset: Dataset) -> str:
    lengths = dataset.lengths
    quartiles = ", ".join(f"{length:g}" for length in np.percentile(lengths, [25, 50, 75]))
    rows = [
        ("episodes", f"{len(dataset):,}"),
        ("steps", f"{int(lengths.sum()):,}"),
        ("duration", f"{lengths.sum() / dataset.info['fps'] / 60:,.1f} min"),
        ("episode length", f"{lengths.min()} to {lengths.max()} steps; quartiles {quartiles}"),
    ]
    metadata = dataset.metadata | {"success": dataset.successes() or []}
    facts = {key: [value for value in values if value is not None] for key, values in metadata.items()}
    for key, values in sorted(facts.items()):
        if values and all(isinstance(value, bool) for value in values):
            share = sum(map(bool, values)) / len(values)
            rows.append((in_markdown(key), f"{sum(map(bool, values)):,} of {len(values):,} episodes ({share:.1%})"))
        elif key == "return" and values:
            returns = np.array(values, dtype=np.float64)
            rows.append((key, f"mean {returns.mean():.2f}; {returns.min():.2f} to {returns.max():.2f}"))
    return _table(("what", "value"), rows)


def _columns(dataset: Dataset) -> str:
    columns = [Column.from_feature(name, feature) for name, feature in dataset.features.items()]
    rows = []
    wide: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        if column.name not in RESERVED or column.meaning:
            meaning, labels = in_markdown(column.meaning), tuple(map(in_markdown, column.names or ()))
            if labels and column.size > WIDE:
                wide.setdefault(labels, []).append(column.name)
            elif labels:
                meaning = f"{meaning}: {', '.join(labels)}".removeprefix(": ")
            runs = [(in_markdown(unit), len([*run])) for unit, run in groupby((column.astra or {}).get("unit", []))]
            units = ", ".join(unit if count == 1 else f"{unit} ({count})" for unit, count in runs)
            rows.append((in_code(column.name), column.dtype, f"({column.size},)", units, meaning))
    for name, camera in dataset.cameras.items():
        kind, size = camera.feature["dtype"], ", ".join(map(str, camera.feature["shape"]))
        rows.append((in_code(name), kind, f"({size})", "", "pictures"))
    plain = [f"`{column.name}`" for column in columns if column.name in RESERVED and not column.meaning]
    order = [f"In {' and '.join(map(in_code, same))}, in order: {', '.join(names)}." for names, same in wide.items()]
    return "\n\n".join(
        [
            _table(("column", "type", "shape", "units", "meaning"), rows),
            *order,
            f"LeRobot's own columns are {', '.join(plain)}. Frames, and what turns or shifts with the world, "
            f"stand in `{layout.INFO_PATH}` under `astra`.",
        ]
    )


def _provenance(description: dict[str, Any]) -> str:
    parents = [f"{full_name(parent)} ({in_code(parent['hash'])})" for parent in description["parents"]]
    packages = [f"{name} {version}" for name, version in description["packages"].items()]
    made = {key: description[key] for key in ("config", "seeds", "environment", "simulator")}
    rows = [
        ("version", description["version"]),
        ("made by stage", in_markdown(description["stage"])),
        ("from", "; ".join(parents) or "nothing earlier"),
        *((key, in_code(json.dumps(of, ensure_ascii=False)) if of else "none") for key, of in made.items()),
        ("packages", in_markdown(", ".join(packages))),
        ("commit", in_code(description["git_commit"]) if description["git_commit"] else "not recorded"),
        ("content hash (sha256)", f"`{description['content_hash']}`"),
    ]
    return _table(("what", "value"), rows)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    cells = ([" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows)
    return table(head, cells, words=len(head))
