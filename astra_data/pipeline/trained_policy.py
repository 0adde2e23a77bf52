"""Load a policy that a run has trained, ready to act."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.artifact import check_made_from
from astra_data.core.config import did_you_mean
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RECORD, RUNS, artifact_key
from astra_data.dataset.columns import STATE
from astra_data.dataset.reader import Dataset
from astra_data.dataset.statistics import ranges
from astra_data.grounding.files import GROUNDING, TARGET_ENCODER, grounding_at, load_target_encoder
from astra_data.methods import grounded_as, method_named
from astra_data.pipeline.recipe import add_all, check_unchanged, recorded_settings
from astra_data.policies.running_policy import POLICY, PolicyFile, RunningPolicy, running
from astra_data.robots.registry import task_named
from astra_data.worlds.user_code import found_near


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy that a run has trained, with its files by their stages, and its dataset, if that is still there."""

    settings: dict[str, Any]
    files: dict[str, Path]
    file: PolicyFile
    dataset: Dataset | None = None

    def recorded(self) -> tuple[list[float], list[float]] | None:
        """Return the least and the largest of each value of the recorded states; None if not known."""
        if self.dataset is None:
            return None
        found = ranges(self.dataset.blocks([STATE]))[STATE]
        least, largest = (np.asarray(found[end], float).tolist() for end in ("min", "max"))
        return least, largest

    def running(self) -> RunningPolicy:
        """Return it ready to act, with the encoder that it is deployed with, if it has one."""
        encoder = load_target_encoder(self.files["align"]) if "align" in self.files else None
        asked = self.settings.get("evaluate", {}).get("encoder")
        is_used = encoder is not None and (asked == "target" or (asked is None and encoder.is_deployed))
        sensing = encoder if encoder is not None and encoder.inputs else None
        task, grounding = task_named(self.settings["task"]), grounding_at(self.files.get("ground"))
        return running(task, self.file, grounding, encoder if is_used else None, sensing)


def trained_policy(run: str | Path, row: str, *, seed: int = 0, percent: int | None = None) -> TrainedPolicy:
    """Return the policy of a row of a run, with its files and the settings of its recipe."""
    settings = settings_of(run)
    files = _files(settings, Path(run), row, seed, percent)
    data = Path(run) / artifact_key("pair" if percent is None else "subset", "", seed, percent)
    dataset = Dataset.open(data) if data.is_dir() else None
    grounding = file_digest(files["ground"]) if "ground" in files else None
    data_hash = dataset.content_hash if dataset else None
    for made, file in files.items():
        check_made_from(file, {"grounding": None if made == "ground" else grounding, "dataset": data_hash})
    return TrainedPolicy(settings, files, PolicyFile.load(files["train"]), dataset)


def load_policy(run: str | Path, row: str, *, seed: int = 0, percent: int | None = None) -> RunningPolicy:
    """Load the policy of a row of the run in a folder, with the encoder that its run tests it with, if it has one.

    Call `start` before the first `command`. `percent` is the dataset's size, where the recipe sweeps over sizes.

    Raises:
        BadInputError: the run has no such policy, an artifact of it is not there, was altered or made from another
            than lies there now, or the code of the task or the method changed since.

    Example:
        >>> from astra_data import load_policy
        >>> policy = load_policy("runs/antmaze_quick", "astra")
        >>> policy.start(1)
        >>> velocity = policy.command(state, goal)  # (1, 29) and (1, 2) in, (1, 2) in m/s out

    With `[align] inputs`, `command` takes these by name instead of a state, or pictures instead of their features:
    `policy.command({"observation.images.front": pictures}, goal)`.
    """
    return trained_policy(run, row, seed=seed, percent=percent).running()


def settings_of(run: str | Path) -> dict[str, Any]:
    """Return the settings of a run's recipe; the user's files are looked up in its folder and above, and else here."""
    folder = Path(run)
    if not (folder / RECORD).is_file():
        known = [str(record.parent) for record in sorted(RUNS.glob(f"*/{RECORD}"))]
        expected = f"expected the folder of a run (with {RECORD}): make it with astra-data run"
        raise BadInputError(f"{run}: {expected}{did_you_mean(str(run), known)}")
    settings = recorded_settings(folder)
    settings["task"] = found_near(settings["task"], folder)
    check_unchanged(settings["task"], folder)
    for own in settings.get("user_methods", {}).values():
        own["method"] = found_near(own["method"], folder)
    return settings


def check_seed(settings: dict[str, Any], seed: int) -> None:
    """Refuse a `seed` that the `settings` of a run do not have."""
    if seed not in (seeds := settings.get("seeds", [seed])):
        raise BadInputError(f"the run has no seed {seed}; its seeds: {', '.join(map(str, seeds))}")


def _files(settings: dict[str, Any], folder: Path, row: str, seed: int, percent: int | None) -> dict[str, Path]:
    user_methods = settings.get("user_methods", {})
    add_all(user_methods)
    files = {"train": folder / artifact_key("train", row, seed, percent) / POLICY}
    if not files["train"].is_file():
        if row not in (rows := settings.get("methods", [row])):
            raise BadInputError(f"the run has no row '{row}'{did_you_mean(row, rows)}")
        check_seed(settings, seed)
    method, base = method_named(row), grounded_as(row)
    if not method.trains:
        raise BadInputError(f"{row} has no trained policy: it is written by hand")
    sizes = settings.get("sweep", {}).get("percent", ())
    if percent not in (sizes or (None,)):
        wanted = f"one of {', '.join(map(str, sizes))}" if sizes else "none, as the recipe has one size"
        raise BadInputError(f"{folder}: percent: expected {wanted}, got {percent or 'none'}")
    for name in user_methods.keys() & {method.name, base}:
        check_unchanged(user_methods[name]["method"], folder, name=name)
    if method.grounds:
        files["ground"] = folder / artifact_key("ground", base, seed, percent) / GROUNDING
    is_read = (settings.get("align") or {}).get("inputs") or (settings.get("evaluate") or {}).get("encoder") != "source"
    if method.aligns and is_read:
        files["align"] = folder / artifact_key("align", base, seed, percent) / TARGET_ENCODER
    if missing := [f"{path} (astra-data {stage})" for stage, path in files.items() if not path.is_file()]:
        raise BadInputError(f"{row}, seed {seed}: expected {', '.join(missing)}: run the recipe first")
    return files
