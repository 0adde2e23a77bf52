"""From CSV logs alone, with a task that has no target, to a policy and a page."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from quick_runs import small_tables

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import GOAL, REWARD
from astra_data.dataset.edit import filter_episodes, subset
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset
from astra_data.pipeline.experiment import condition, load_experiment
from astra_data.pipeline.plan import plan
from astra_data.pipeline.run import check, run, set_aside
from astra_data.pipeline.stages.label import label
from astra_data.pipeline.trained_policy import load_policy
from astra_data.reports.artifacts import EVALUATION, Evaluation, read_json
from astra_data.reports.held_out import write_held_out
from astra_data.reports.runs import Selection

pytestmark = pytest.mark.usefixtures("quick_fits")
CART = Path(__file__).parents[2] / "recipes/examples/cart"
SMALL = small_tables(held_out_share=0.25, episodes=3)


def made(
    folder: Path, name: str, text: str, wanted: Callable[[str], bool] = lambda stage: True
) -> tuple[Path, list[str]]:
    """Make the artifacts of a recipe in this process; return its folder and their keys."""
    path = folder / f"{name}.toml"
    path.write_text(f'task = "cart.py:TASK"\ndata = "logs"\nseeds = [0]\n{text}{SMALL}')
    experiment = load_experiment(path, folder / "runs")
    items = [item for item in plan(experiment.recipe, path, experiment.folder) if wanted(item.key)]
    for item in items:
        item.call()
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    return experiment.folder, [item.key for item in items]


def test_logs_become_policies_and_a_page_without_a_target(cart: Path) -> None:
    rows = 'methods = ["direct_transfer", "nas", "astra"]\n'
    folder, _ = made(cart, "cart", rows, lambda key: key.startswith(("evaluate", "report")))
    assert not (folder / "collect").exists()
    labeled = Dataset.open(folder / "label/seed_0")
    assert REWARD in labeled.features and GOAL not in labeled.features and len(labeled) == 8
    for row in ("direct_transfer", "nas", "astra"):
        evaluation = read_json(Evaluation, folder / "evaluate" / row / "seed_0" / EVALUATION)
        assert evaluation.tested_in == "grounded" and evaluation.target is None
        assert evaluation.outcomes == evaluation.grounded and evaluation.raw is not None
    assert evaluation.grounded != evaluation.simulated
    page = (folder / "report/results.md").read_text().splitlines()
    assert page[2].startswith("> **Nothing was tested on a robot: the task has no target.** All methods were tested")
    assert "in which only NAS trained" in page[2]
    text = "\n".join(page[3:])
    assert "over seeds, in the simulator grounded by NAS" in text and "n the target." not in text
    assert not re.search(r"wall contact|maze", text) and "Correlation with" not in text
    results = json.loads((folder / "report/results.json").read_text())
    assert results["tested_in"] == "simulators" and results["rows"] == ["direct_transfer", "nas", "astra"]
    assert [dataset["stage"] for dataset in results["datasets"]] == ["label", "pair", "evaluate"]
    policy = load_policy(folder, "astra")
    policy.start(2)
    action = policy.act(torch.zeros(2, 8), torch.ones(2, 0))
    assert action.shape == (2, 2) and bool(np.isfinite(action.numpy()).all())


def test_held_out_errors_say_how_much_data_is_enough(cart: Path) -> None:
    until = ("label", "pair", "subset", "ground")
    text = 'methods = ["nas"]\n[sweep]\npercent = [50, 100]\n'
    folder, keys = made(cart, "sizes", text, lambda key: key.split("/")[0] in until)
    assert "subset/percent_050/seed_0" in keys and len(Dataset.open(folder / "subset/percent_050/seed_0")) == 4
    page = write_held_out("sizes", folder, Selection(("nas",), (0,), (50, 100)), timestep_s=0.1)
    assert page is not None
    lines = page.read_text().splitlines()
    gap = json.loads((folder / "ground/nas/percent_050/seed_0/gap.json").read_text())
    of_yaw = lines[lines.index("Error of `heading_x`:") :]
    assert of_yaw[2].startswith("| size | simulator | 1 step (0.1 s) | 10 steps (1 s) |")
    assert of_yaw[4].startswith("| 50 % | No motion (persistence baseline) |")
    # One drive of four is held out: it has no interval.
    assert f"| 50 % | No grounding | {gap['raw']['heading_x']['mean'][0]:.3g} |" in of_yaw[5]
    assert f"| 50 % | NAS, grounded | {gap['grounded']['heading_x']['mean'][0]:.3g} |" in of_yaw[6]
    assert of_yaw[9].startswith("| 100 % | NAS, grounded |")
    assert sum(line.startswith("- NAS, `") for line in lines) == 4


def test_other_data_of_the_same_name_are_labeled_anew(cart: Path, tmp_path: Path) -> None:
    shutil.copy(cart / "cart.py", tmp_path / "cart.py")
    drives = sorted((cart / "csv").glob("*.csv"))
    import_dataset(drives, CART / "logs.toml", out=tmp_path / "logs")
    made(tmp_path, "again", 'methods = ["nas"]\n', lambda key: key.startswith("label"))
    path = tmp_path / "again.toml"

    def labeled() -> tuple[str, str]:
        found = check(path, root=tmp_path / "runs")["label/seed_0"]
        return found.state, found.why

    assert labeled() == ("finished", "")
    shutil.rmtree(tmp_path / "logs")
    import_dataset(drives[:4], CART / "logs.toml", out=tmp_path / "logs")
    assert labeled() == ("stale", "made from another dataset than cart-logs@data-1.0.0")
    set_aside(tmp_path / "runs/again", "label/seed_0")
    made(tmp_path, "again", 'methods = ["nas"]\n', lambda key: key.startswith("label"))
    assert labeled() == ("finished", "") and len(Dataset.open(tmp_path / "runs/again/label/seed_0")) == 4
    # Data that lack nothing are linked to.
    whole = subset(Dataset.open(tmp_path / "runs/again/label/seed_0"), percent=100, out=tmp_path / "whole")
    path = path.rename(tmp_path / "linked.toml")
    path.write_text(path.read_text().replace('data = "logs"', 'data = "whole"'))
    experiment = load_experiment(path, tmp_path / "runs")
    (item,) = [item for item in plan(experiment.recipe, path, experiment.folder) if item.key == "label/seed_0"]
    item.call()
    assert (experiment.folder / "label/seed_0").is_symlink() and condition(item, experiment).state == "finished"
    link = experiment.folder / "label/seed_0"  # what was made of it since is no other; what was made of another is
    older = shutil.copytree(whole, tmp_path / "older")
    shutil.rmtree(whole)
    filter_episodes(Dataset.open(older), without=Dataset.open(older).uids[:1].tolist(), out=whole)
    link.unlink()
    link.symlink_to(older)
    assert condition(item, experiment).state == "finished"
    import_dataset(drives[4:], CART / "logs.toml", out=tmp_path / "others")
    link.unlink()
    link.symlink_to(label(experiment.recipe.task, data=tmp_path / "others", out=tmp_path / "labeled"))
    assert condition(item, experiment).why.startswith("made from another dataset than cart-logs@")


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize("lacks_nothing", [False, True])
def test_all_seeds_begin_with_one_version_of_the_data(lacks_nothing: bool, cart: Path, tmp_path: Path) -> None:
    shutil.copy(cart / "cart.py", tmp_path / "cart.py")
    logs = import_dataset(sorted((cart / "csv").glob("*.csv")), CART / "logs.toml", name="drives").root
    logs = label(f"{tmp_path / 'cart.py'}:TASK", data=logs) if lacks_nothing else logs
    shutil.copytree(logs, tmp_path / "logs")
    folder, _ = made(tmp_path, "one", 'methods = ["nas"]\n', lambda key: key.startswith("label"))
    before = Dataset.open(logs)
    now = Dataset.open(filter_episodes(before, without=before.uids[:1].tolist()))
    path = tmp_path / "one.toml"
    path.write_text(path.read_text().replace('data = "logs"', 'data = "drives"'))
    assert check(path, root=tmp_path / "runs")["label/seed_0"].state == "finished"  # as all are
    path.write_text(path.read_text().replace("seeds = [0]", "seeds = [0, 1]"))
    fault = f"data: {now.reference} is not {before.reference}, which other seeds were made from: name "
    fault += f"{before.reference} as data, or remove {folder / 'label/seed_0'}"
    for command in (check, run):
        with pytest.raises(BadInputError, match=f"^{re.escape(fault)}$"):
            command(path, root=tmp_path / "runs")
    path.write_text(path.read_text().replace('"drives"', f'"{before.reference}"'))
    assert [of.state for of in check(path, root=tmp_path / "runs").values()][1:3] == ["finished", "missing"]
