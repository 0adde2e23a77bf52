"""Methods of the user's: rows beside those of the package."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_cart import TASK

import astra_data.methods as registry
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.progress import silent
from astra_data.experiments.experiment import load_experiment
from astra_data.experiments.plan import plan
from astra_data.experiments.trained_policy import load_policy
from astra_data.grounding.files import KINDS, load_grounding
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.methods import METHODS, add_method, method_named
from astra_data.worlds.own_code import own_object

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "recipes/examples/methods"
SMALL = """
[collect]
episodes = 6
max_steps = 12
start = "task"
hold_s = [0.1, 0.4]
[ground]
updates = 3
window = 5
held_out_share = 0.25
[train]
num_envs = 4
rollout_steps = 8
total_steps = 32
hidden_sizes = [8]
memory_size = 4
[evaluate]
episodes = 3
[report]
bootstrap_replicates = 100
"""


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Forget the methods that a test adds."""
    known = [(registered, dict(registered)) for registered in (METHODS, KINDS, registry._PLACES)]
    kinds = set(registry._OWN_KINDS)
    yield
    for registered, before in known:
        registered.clear()
        registered.update(before)  # type: ignore[arg-type]
    registry._OWN_KINDS.intersection_update(kinds)


def recipe(folder: Path, methods: str, own: str) -> Path:
    path = folder / "own.toml"
    path.write_text(
        f'task = "{ROOT}/tests/small_cart.py:TASK"\nmethods = {methods}\nseeds = [0]\n'
        f"[own_methods]\n{own}{SMALL}"
    )
    return path


def fitting(folder: Path, moved_by: float) -> Fitting:
    """Return steps of a cart that moves by `moved_by` more than its simulator."""
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(8, 20, 1, generator=generator)
    action = 1.2 * torch.rand(8, 20, 1, generator=generator) - 0.6
    simulated = state + 0.1 * TASK.limits.in_units(action)
    windows = SimpleNamespace(
        state=state, action=action, next_state=simulated + moved_by, simulated_next=simulated
    )
    episodes: Any = SimpleNamespace(windows=windows, steps=lambda values: values.flatten(0, 1))
    config = GroundConfig(updates=300)
    return Fitting(TASK, config, None, episodes, episodes, 0, "cpu", folder, silent)


def test_a_delta_action_finds_what_was_added_to_the_commands(tmp_path: Path) -> None:
    method = own_object(f"{EXAMPLES / 'delta_action.py'}:METHOD")
    grounding, _ = method.fit(fitting(tmp_path, moved_by=0.1 * 0.5))
    state, action = torch.linspace(0.1, 0.9, 9)[:, None], torch.linspace(-0.5, 0.5, 9)[:, None]
    added = grounding.delta(torch.cat([state, action], dim=-1))
    # 0.5 m/s of a range of 5 m/s, which is 2 of the action's units.
    torch.testing.assert_close(added, torch.full((9, 1), 0.2), atol=0.02, rtol=0)
    simulator = grounding.simulator(TASK, 9)
    simulator.start(state, torch.arange(9), torch.zeros(9, 1))
    expected = state + 0.1 * (TASK.limits.in_units(action) + 0.5)
    torch.testing.assert_close(simulator.step(action), expected, atol=0.005, rtol=0)


def test_a_residual_ensemble_finds_by_how_much_the_simulator_is_wrong(tmp_path: Path) -> None:
    method = own_object(f"{EXAMPLES / 'residual_ensemble.py'}:METHOD")
    given = fitting(tmp_path, moved_by=0.0)
    windows = given.training.windows
    windows.next_state = windows.simulated_next + 0.3 * windows.state - 0.1 * windows.action  # type: ignore[misc]
    grounding, _ = method.fit(given)
    state, action = torch.linspace(0.1, 0.9, 9)[:, None], torch.linspace(0.5, -0.5, 9)[:, None]
    expected = 0.3 * state - 0.1 * action
    torch.testing.assert_close(grounding.ensemble(state, action), expected, atol=0.03, rtol=0)
    assert 0.0 < float(grounding.scatter(given.training)) < 0.03


def test_they_are_rows_from_the_recipe_to_the_page(tmp_path: Path) -> None:
    own = "".join(
        f'{name} = "{EXAMPLES}/{name}.py:METHOD"\n' for name in ("delta_action", "residual_ensemble")
    )
    path = recipe(tmp_path, '["direct_transfer", "delta_action", "residual_ensemble"]', own)
    experiment = load_experiment(path, tmp_path / "runs")
    for item in plan(experiment.recipe, path, experiment.folder):
        item.call(progress=silent)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    fitted = load_grounding(experiment.folder / "ground/delta_action/seed_0/grounding.safetensors")
    assert fitted.kind == "delta action"
    page = (experiment.folder / "report/results.md").read_text()
    assert "| Delta action |" in page and "| Residual ensemble |" in page
    METHODS.pop("delta_action"), registry._PLACES.pop("delta_action")
    policy = load_policy(experiment.folder, "delta_action")  # by what the run recorded
    policy.start(2)
    assert policy.act(torch.zeros(2, 2), torch.ones(2, 1)).shape == (2, 1)


def test_a_file_is_looked_up_beside_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text((EXAMPLES / "delta_action.py").read_text())
    path = recipe(tmp_path, '["mine", "mine_plus"]', 'mine = "mine.py:METHOD"\n')
    loaded = load_experiment(path, tmp_path / "runs").recipe
    assert loaded.own_methods == {"mine": str(tmp_path / "mine.py:METHOD")}
    assert METHODS["mine"].name == "mine" and METHODS["mine"].title == "Delta action"


@pytest.mark.parametrize(
    ("name", "place", "told"),
    [
        ("nas", "delta_action.py:METHOD", "method 'nas' is one of the package: give .* another name"),
        ("Mine", "delta_action.py:METHOD", "method 'Mine': expected a name of a-z"),
        ("mine_plus", "delta_action.py:METHOD", "that does not end in _plus"),
        ("mine", "delta_action.py:fit", "delta_action.py:fit is a function, expected a Method"),
        ("mine", "delta_actoin.py:METHOD", "delta_actoin.py does not exist"),
    ],
)
def test_what_is_no_method_is_refused_in_one_line(tmp_path: Path, name: str, place: str, told: str) -> None:
    path = recipe(tmp_path, f'["{name}"]', f'{name} = "{EXAMPLES}/{place}"\n')
    with pytest.raises(RecipeError, match=told) as caught:
        load_experiment(path, tmp_path / "runs")
    assert "\n" not in str(caught.value)


def test_a_kind_of_the_package_is_not_replaced(tmp_path: Path) -> None:
    text = (EXAMPLES / "delta_action.py").read_text().replace('kind = "delta action"', 'kind = "residual"')
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(BadInputError, match="groundings of kind 'residual' are the package's"):
        add_method("mine", f"{tmp_path / 'mine.py'}:METHOD")
    assert "mine" not in METHODS


def test_installed_packages_offer_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = {"theirs": f"{EXAMPLES / 'delta_action.py'}:METHOD"}
    monkeypatch.setattr(registry, "_installed", lambda: offered)
    assert method_named("theirs_plus").title == "Delta action"
    with pytest.raises(BadInputError, match="unknown method 'thiers'"):
        method_named("thiers")
