"""Training data, models and test data of a study; finished fits are kept and not repeated."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.durable import alone_in, write_file
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, Stopwatch, part
from astra_data.core.provenance import origin
from astra_data.core.seeding import generator
from astra_data.studies.errors import Starts, summary
from astra_data.studies.gap_recipe import GapRecipe
from astra_data.studies.recordings import Piece, Recording
from astra_data.studies.rollouts import fit
from astra_data.studies.sequences import Sequences

LEARNED = ("mlp", "nas", "astra")
"""Models that depend on the seed even with all the data."""


@dataclass(frozen=True)
class Case:
    """Training data and test data.

    Attributes:
        name: of its folder. title: heading on the page.
        training: pieces to learn from. test: pieces to predict.
        minutes: sizes of the training data, besides all of it.
    """

    name: str
    title: str
    training: tuple[Piece, ...]
    test: tuple[Piece, ...]
    minutes: tuple[float, ...] = ()


def cases(recipe: GapRecipe, data: Sequence[Recording], train: Sequence[Recording]) -> Iterator[Case]:
    """Yield the cases that test on `data`: learned from `train` if given, else from parts of `data`."""
    if train:
        test = tuple(piece for recording in data for piece in recording.pieces)
        training = tuple(piece for recording in train for piece in recording.pieces)
        title = f"Learned from {_listed(train)}, tested on {_listed(data)}"
        yield Case("new_recordings", title, training, test, recipe.minutes)
        return
    training, test = _held_out(data, recipe.held_out_share)
    title = f"Tested on held-out pieces of {_listed(data)}"
    yield Case("held_out_pieces", title, training, test, recipe.minutes)
    for recording in data if len(data) > 1 else ():
        others = [other for other in data if other is not recording]
        training = tuple(piece for other in others for piece in other.pieces)
        title = f"Learned from {_listed(others)}, tested on {recording.name}"
        yield Case(f"tested_on_{recording.name}", title, training, recording.pieces)


def _listed(recordings: Sequence[Recording]) -> str:
    return " and ".join(recording.name for recording in recordings)


def _held_out(data: Sequence[Recording], share: float) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    training: list[Piece] = []
    test: list[Piece] = []
    for recording in data:
        order = generator(0, f"held-out pieces of {recording.content_hash}").permutation(
            len(recording.pieces)
        )
        count = max(1, min(round(share * len(order)), len(order) - 1))
        for place, number in enumerate(order):
            (test if place < count else training).append(recording.pieces[number])
    if not training:
        raise BadInputError(
            f"{_listed(data)}: expected at least two pieces without a split, to learn from one and predict "
            "the other; pass recordings to learn from with --train"
        )
    return tuple(training), tuple(test)


def shortened(pieces: Sequence[Piece], rows: int, seed: int) -> tuple[Piece, ...]:
    """Return pieces of `rows` rows in total, the first of a random order: a smaller size is a subset."""
    kept: list[Piece] = []
    for number in generator(seed, "pieces to learn from").permutation(len(pieces)):
        piece, room = pieces[number], rows - sum(map(len, kept))
        if room <= 0:
            break
        columns = (piece.state[: room + 1], piece.action[:room], piece.broken[:room])
        kept.append(Piece(piece.recording, *columns, piece.body))
    return tuple(kept)


def run_study(
    recipe: GapRecipe, data: Sequence[Recording], train: Sequence[Recording], folder: Path, progress: Progress
) -> dict[str, Any]:
    """Fit and test every model of every case, except for fits that are in `folder`; return the results.

    Raises:
        BadInputError: `folder` holds results of other settings or recordings, or is in use; or the recordings
            are too short.
    """
    every = [*data, *train]
    rates = {recording.fps for recording in every}
    if len(rates) > 1:
        raise BadInputError(
            f"expected recordings of one rate, got {', '.join(map(str, sorted(rates)))} per second"
        )
    bodies = [recording.pieces[0].body for recording in every]
    if any(body != bodies[0] for body in bodies):
        raise BadInputError("expected recordings of the same joints, with targets in all or in none")
    fps = rates.pop()
    free = {"notes", "models", "seeds", "minutes"}
    free |= {"walking"} if recipe.simulator == "joints" else {"joints", "simulator"}
    settings = {
        "recipe": recipe.model_dump(mode="json", exclude=free),
        "data": [recording.content_hash for recording in data],
        "train": [recording.content_hash for recording in train],
    }
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        _check_same(folder / "config.json", settings)
        made, stopwatch, found = origin(), Stopwatch(), []
        chosen = list(cases(recipe, data, train))
        amounts = [len(list(_fits(recipe, case, fps))) for case in chosen]
        for number, case in enumerate(chosen):
            before, after = (sum(amounts[:end]) / sum(amounts) for end in (number, number + 1))
            found.append(_tested(recipe, case, fps, folder / case.name, part(progress, before, after)))
        return {
            "config": recipe.model_dump(mode="json"),
            "step_s": recipe.steps.rows / fps,
            "recordings": [_described(recording) for recording in every],
            "has_targets": bodies[0].given_size > 0,
            "cases": found,
            "origin": made | stopwatch.spent(),
        }


def _check_same(path: Path, settings: dict[str, Any]) -> None:
    text = json.dumps(settings, indent=1)
    begun = any(path.parent.rglob("*.safetensors"))
    if begun and path.exists() and path.read_text() != text:
        raise BadInputError(
            f"{path.parent} holds results of other settings or other recordings: remove it, or name another "
            "folder with --root"
        )
    write_file(path, text)


def _described(recording: Recording) -> dict[str, Any]:
    return {
        "name": recording.name,
        "content_hash": recording.content_hash,
        "minutes": recording.minutes,
        "pieces": len(recording.pieces),
        "broken_share": recording.broken_share,
    }


def _sizes(case: Case, fps: int) -> list[float]:
    """Return the minutes of data that the case learns from, all of them first."""
    whole = sum(map(len, case.training)) / fps / 60
    return [whole, *(minutes for minutes in sorted(case.minutes, reverse=True) if minutes < whole)]


def _fits(recipe: GapRecipe, case: Case, fps: int) -> Iterator[tuple[float, str, int]]:
    """Yield minutes, model and seed of every fit; with all the data, seeds change only the networks."""
    sizes = _sizes(case, fps)
    for minutes, name, seed in product(sizes, recipe.models, recipe.seeds):
        needs_seeds = name in LEARNED or (minutes < sizes[0] and name != "raw")
        if needs_seeds or seed == recipe.seeds[0]:
            yield minutes, name, seed


def _tested(recipe: GapRecipe, case: Case, fps: int, folder: Path, progress: Progress) -> dict[str, Any]:
    """Fit and test the models of one case; return their errors by data size."""
    steps_config = recipe.steps
    step_s = steps_config.rows / fps
    rounded = [max(1, round(seconds / step_s)) for seconds in recipe.horizons_s]
    asked = tuple(dict.fromkeys([1, *rounded]))
    starts = Starts.of(Sequences.of_pieces(case.test, fps, steps_config), steps_config.history, asked)
    horizons_s = [horizon * step_s for horizon in starts.horizons]
    body = starts.stretch.body
    fits = list(_fits(recipe, case, fps))
    squared: dict[float, dict[str, list[Any]]] = {}
    drawn_once: dict[tuple[float, int], Sequences] = {}
    cpu_seconds = 0.0
    for number, (minutes, name, seed) in enumerate(fits):
        size = "all" if minutes == fits[0][0] else f"{minutes:g}_min"
        path = folder / name / size / f"seed_{seed}.safetensors"
        if not path.exists():
            drawn = (minutes, recipe.seeds[0] if size == "all" else seed)
            if drawn not in drawn_once:
                rows = max(1, round(minutes * 60 * fps))
                pieces = case.training if size == "all" else shortened(case.training, rows, seed)
                drawn_once[drawn] = Sequences.of_pieces(pieces, fps, steps_config)
            share = part(progress, number / len(fits), (number + 1) / len(fits))
            _fit_one(
                name,
                drawn_once[drawn],
                recipe,
                seed,
                starts,
                path,
                _labeled(share, f"{case.name}/{name}/{size}/{seed}"),
            )
        tensors, metadata = load_tensors(path)
        cpu_seconds += metadata["cpu_seconds"]
        errors = tensors[_ERRORS].double().numpy()
        squared.setdefault(minutes, {}).setdefault(name, []).append(errors)
    by_size = [
        {
            "minutes": minutes,
            "models": summary(
                {name: np.stack(values) for name, values in models.items()},
                starts.piece,
                horizons_s,
                axes=body.axes,
                judged=body.judged,
            ),
        }
        for minutes, models in sorted(squared.items())
    ]
    all_count = starts.stretch.all_count[:, [horizon - 1 for horizon in starts.horizons]]
    return {
        "name": case.name,
        "title": case.title,
        "axes": list(body.axes),
        "judged": list(body.judged),
        "horizons_s": horizons_s,
        "starts": all_count.sum(0).tolist(),
        "pieces": len(np.unique(starts.piece)),
        "test_minutes": sum(map(len, case.test)) / fps / 60,
        "fit_cpu_seconds": cpu_seconds,
        "sizes": by_size,
    }


_ERRORS = "squared_error"


def _fit_one(
    name: str,
    sequences: Sequences,
    recipe: GapRecipe,
    seed: int,
    starts: Starts,
    path: Path,
    progress: Progress,
) -> None:
    """Fit a model, test it, and write both its weights and its errors to `path`."""
    stopwatch = Stopwatch()
    model = fit(name, sequences, recipe.steps.history, recipe.fit, seed, progress)
    tensors = {f"model.{key}": value for key, value in model.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"model": name, "seed": seed, **stopwatch.spent()}
    save_tensors(path, tensors | {_ERRORS: starts.squared_errors(model)}, metadata)


def _labeled(progress: Progress, label: str) -> Progress:
    """Return progress with `label` before every note."""
    return lambda fraction, note: progress(fraction, f"{label}  {note}")
