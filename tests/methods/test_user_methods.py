"""Methods of the user's: rows beside those of the package."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rail_run import SMALL as RAIL
from small_cart import GIVEN, TASK, Rail
from toy_episodes import toy_episodes

import astra_data.methods as registry
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.progress import silent
from astra_data.grounding.files import load_grounding
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.methods import METHODS, add_method
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.plan import plan
from astra_data.pipeline.trained_policy import load_policy
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import user_object

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "recipes/examples/methods"
ANTS = TASKS["antmaze-umaze"]
CARTS = user_object(f"{ROOT}/recipes/examples/cart/cart.py:TASK")
pytestmark = pytest.mark.usefixtures("forgotten_methods")
SMALL = RAIL.replace('max_steps = 40\nstart = "task"', "max_steps = 12")


def recipe(folder: Path, methods: str, own: str) -> Path:
    path = folder / "own.toml"
    path.write_text(
        f'task = "{ROOT}/tests/small_cart.py:TASK"\nmethods = {methods}\nseeds = [0]\n[user_methods]\n{own}{SMALL}'
    )
    return path


def fitting(folder: Path, moved_by: float = 0.0, task: Task = TASK) -> Fitting:
    """Return steps of a cart that moves by `moved_by` more than its simulator."""
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(8, 20, 1, generator=generator)
    action = 1.2 * torch.rand(8, 20, 1, generator=generator) - 0.6
    simulated = state + 0.1 * TASK.limits.in_units(action)
    windows = SimpleNamespace(
        state=state, action=action, next_state=simulated + moved_by, simulated_next=simulated, mask=torch.ones(8, 20)
    )
    episodes: Any = SimpleNamespace(
        windows=windows,
        lengths=torch.full((8,), 20),
        steps=lambda values: values.flatten(0, 1),
        draw_windows=lambda count, length: (windows, None),
    )
    config = GroundConfig(updates=300)
    return Fitting(task, config, None, episodes, episodes, 0, "cpu", folder, silent)


class NumpyRail(Rail):
    """The same, of arrays, which have no gradients."""

    def step(self, command: torch.Tensor) -> torch.Tensor:
        return super().step(command.detach())


DELTA = f"{EXAMPLES / 'delta_action.py'}:METHOD"


@pytest.mark.parametrize("simulator", [Rail, NumpyRail])
def test_a_delta_action_finds_what_was_added_to_the_commands(tmp_path: Path, simulator: type[Rail]) -> None:
    method, task = user_object(DELTA), Task(**GIVEN | {"make_simulator": simulator})
    given = replace(fitting(tmp_path, 0.1 * 0.5, task), settings=method.table.model())
    grounding, _ = method.fit(given)
    windows = given.training.windows
    added, _ = grounding.delta(windows.state, windows.action)
    # 0.5 m/s of a range of 5 m/s, which is 2 of the action's units.
    torch.testing.assert_close(added, torch.full((8, 20, 1), 0.2), atol=0.07, rtol=0)
    # A replay that begins within an episode remembers what was before.
    before = grounding.hidden_before(windows, every=6)
    assert before.shape == (8, 4, 32) and not before[:, 0].any()
    remembering = grounding.simulator(task, 8)
    remembering.start(windows.state[:, 6], torch.arange(8), torch.zeros(8, 1), hidden=before[:, 1])
    after = remembering.step(windows.action[:, 6])
    commands = task.limits.in_units(windows.action + added)
    torch.testing.assert_close(after, (windows.state + 0.1 * commands)[:, 6])
    assert not torch.allclose(added[:, 6], grounding.delta(windows.state[:, 6:7], windows.action[:, 6:7])[0][:, 0])


def test_each_member_of_an_ensemble_learns_the_correction_and_an_episode_keeps_its_member(tmp_path: Path) -> None:
    method = user_object(f"{EXAMPLES / 'gru_ensemble.py'}:METHOD")
    given = replace(fitting(tmp_path), config=GroundConfig(updates=100))
    windows = given.training.windows
    windows.next_state = windows.simulated_next + 0.3 * windows.state - 0.1 * windows.action  # type: ignore[misc]
    grounding, _ = method.fit(given)
    every, _ = grounding.ensemble(windows.state, windows.action, windows.simulated_next, torch.zeros(8, 5 * 64))
    expected = 0.3 * windows.state - 0.1 * windows.action
    assert every.shape == (5, 8, 20, 1)
    torch.testing.assert_close(every[:, :, 2:], expected.expand(5, -1, -1, -1)[:, :, 2:], atol=0.06, rtol=0)
    simulator = type(grounding).from_file(*grounding.to_file(), "cpu").simulator(TASK, 8)
    torch.manual_seed(0)
    simulator.start(windows.state[:, 0], torch.arange(8), torch.zeros(8, 1))
    member, before = simulator.member.clone(), grounding.hidden_before(windows, every=3)
    assert len(set(member.tolist())) > 2 and before.shape == (8, 7, 320) and not before[:, 0].any()
    for step in range(6):
        simulator.simulator.reset_to(windows.state[:, step])
        after = simulator.step(windows.action[:, step])
        corrected = windows.simulated_next[:, step] + every[member, torch.arange(8), step]
        torch.testing.assert_close(after, corrected, atol=1e-5, rtol=0)
    assert torch.equal(simulator.member, member)
    torch.testing.assert_close(simulator.hidden, before[:, 2], atol=1e-5, rtol=0)


@torch.no_grad()
def late_carts(response: Any, count: int, seed: int) -> Any:
    """Return drives of 60 steps of the example's unicycle, whose commands act as `response` says."""
    generator = torch.Generator().manual_seed(seed)
    action = (2 * torch.rand(count, 20, 2, generator=generator) - 1).repeat_interleave(3, dim=1)
    simulator = CARTS.simulator(count)
    states = [simulator.state]
    states += [simulator.step(felt) for felt in response.sequence(action)[0].unbind(1)]
    along = torch.stack(states, dim=1)
    return toy_episodes(along[:, :-1], action, next_state=along[:, 1:])


@pytest.mark.parametrize(
    ("gain", "offset", "share", "delay"),
    [((0.8, 0.6), (0.05, -0.1), (0.5, 0.35), 2), ((0.9, 0.7), (0.0, 0.1), (1.0, 0.8), 0)],
)
def test_fitted_parameters_are_those_that_were_planted(
    tmp_path: Path, gain: Any, offset: Any, share: Any, delay: int
) -> None:
    method = user_object(f"{EXAMPLES / 'parameters.py'}:METHOD")
    still = CARTS.limits.normal(torch.zeros(2))
    planted = sys.modules[method.fit.__module__].Response(*map(torch.tensor, (gain, offset, share)), still, delay)
    training, held_out = late_carts(planted, 20, 0), late_carts(planted, 4, 1)
    settings = method.table.model(windows=100, longest_delay=3)
    given = Fitting(CARTS, GroundConfig(), settings, training, held_out, 0, "cpu", tmp_path, silent)
    grounding, figures = method.fit(given)
    assert figures["delay"] == delay
    for name, values in (("gain", gain), ("offset", offset), ("share", share)):
        assert figures[name] == pytest.approx(values, abs=0.01), name
    again, windows = type(grounding).from_file(*grounding.to_file(), "cpu"), held_out.windows
    before = again.hidden_before(windows)
    simulator = again.simulator(CARTS, 4)
    # From the middle of an episode, it goes on as the robot did.
    simulator.start(windows.state[:, 30], torch.arange(4), windows.goal[:, 30], hidden=before[:, 30])
    for step in range(30, 59):
        after = simulator.step(windows.action[:, step])
    torch.testing.assert_close(after, windows.next_state[:, 58], atol=0.03, rtol=0)
    assert before.shape == (4, 60, 2 * (delay + 1)) and torch.equal(before[:, 0], still.repeat(4, delay + 1))


def test_golemos_lstm_learns_a_lag_that_only_a_memory_knows(tmp_path: Path) -> None:
    torch.manual_seed(0)
    state, simulated, action = *torch.randn(2, 40, 40, 4), torch.randn(40, 40, 2)
    lacking = torch.nn.functional.pad(0.1 * action[:, :-2], (0, 2, 2, 0))  # commanded two steps before
    both = toy_episodes(state, action, next_state=simulated + lacking, simulated_next=simulated)
    training, held_out = both.select(torch.arange(32)), both.select(torch.arange(32, 40))
    method = user_object(f"{EXAMPLES / 'nas_golemo.py'}:METHOD")
    settings = method.table.model(epochs=12, hidden_size=16, layers=2, learning_rate=0.01)
    given = Fitting(ANTS, GroundConfig(), settings, training, held_out, 0, "cpu", tmp_path, silent)
    grounding, figures = method.fit(given)
    assert figures["loss"] < 0.2  # 1 is the variance of what is lacking
    windows = held_out.windows
    simulator = grounding.simulator(ANTS, 8)
    simulator.start(windows.state[:, 0], torch.arange(8), windows.goal[:, 0])
    before = grounding.hidden_before(windows, every=10)
    assert before.shape == (8, 4, 2 * 2 * 16) and not before[:, 0].any() and before[:, 1].any()


def test_causal_compass_finds_the_parameters_that_were_planted(tmp_path: Path) -> None:
    method, ranges = user_object(f"{EXAMPLES / 'compass_causal.py'}:METHOD"), ANTS.varied.wide
    planted = {"friction": (0.92, 0.92), "timestep_scale": (1.1, 1.1), "heading_bias_deg": (3.0, 3.0)}
    start = torch.tensor([*ANTS.maze.cell_center(*ANTS.maze.start), 0.0, 0.0]).float()
    sets = []
    for seed, count in enumerate((16, 4)):
        torch.manual_seed(seed)
        target = ANTS.varied_simulator(count, type(ranges)(**planted))
        target.reset_to(start.repeat(count, 1))
        action = (2 * torch.rand(count, 4, 2) - 1).repeat_interleave(15, dim=1)
        states = torch.stack([target.state, *(target.step(one) for one in action.unbind(1))], dim=1)
        sets.append(toy_episodes(states[:, :-1], action, next_state=states[:, 1:]))
    quiet = {"action_noise": (0.0, 0.0), "position_noise_m": (0.0, 2e-3), "velocity_noise_m_s": (0.0, 2e-3)}
    task = replace(ANTS, varied=replace(ANTS.varied, wide=ranges.model_copy(update=quiet)))
    settings = method.table.model(contexts=64, windows=60, window=15, updates=200, iterations=3)
    grounding, figures = method.fit(
        Fitting(task, GroundConfig(), settings, sets[0], sets[1], 0, "cpu", tmp_path, silent)
    )
    point = figures["point"]
    assert point["friction"] * (1 + point["action_scale"]) == pytest.approx(0.92, rel=0.03)
    assert point["timestep_scale"] == pytest.approx(1.1, rel=0.03)
    assert point["heading_bias_deg"] == pytest.approx(3.0, abs=1.5)
    (plain, *_), (identified, *_) = figures["held_out_gap"]
    assert identified < 0.3 * plain
    again = type(grounding).from_file(*grounding.to_file(), "cpu")
    assert again.variation == grounding.variation and grounding.variation.friction == (point["friction"],) * 2
    assert grounding.variation.position_noise_m == (0.0, 2e-3)  # noise is not identified
    assert grounding.for_replay().variation == type(ranges)(**{name: (value, value) for name, value in point.items()})


NAMED = ("delta_action", "nas_golemo", "sb3_ppo", "parameters", "gru_ensemble")


@pytest.mark.usefixtures("quick_fits")
def test_they_are_rows_from_the_recipe_to_the_page(tmp_path: Path) -> None:
    own = "".join(f'{name} = "{EXAMPLES}/{name}.py:METHOD"\n' for name in NAMED)
    rows = str(["direct_transfer", *NAMED])
    path = recipe(tmp_path, rows, own)
    experiment = load_experiment(path, tmp_path / "runs")
    for item in plan(experiment.recipe, path, experiment.folder):
        item.call(progress=silent)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    fitted = load_grounding(experiment.folder / "ground/delta_action/seed_0/grounding.safetensors")
    assert fitted.kind == "delta action"
    page = (experiment.folder / "report/results.md").read_text()
    for row in ("Delta action", "NAS (Golemo et al.)", "NAS, PPO of SB3", "Fitted parameters", "GRU ensemble"):
        assert f"| {row} |" in page
    assert not (experiment.folder / "ground/sb3_ppo").exists()  # it is trained in NAS's simulator
    METHODS.pop("delta_action"), registry._PLACES.pop("delta_action")
    policy = load_policy(experiment.folder, "delta_action")  # by what the run recorded
    policy.start(2)
    assert policy.act(torch.zeros(2, 2), torch.ones(2, 1)).shape == (2, 1)


@pytest.mark.parametrize(
    ("method", "given", "told"),
    [
        (
            "delta_action",
            "memroy = 4",
            "own.toml: user_methods: delta_action: memroy: unknown key: did you mean 'memory'",
        ),
        ("delta_action", "memory = 0", "memory: expected greater than or equal to 1, got 0"),
        ("gru_ensemble", "members = 3", "gru_ensemble.py:METHOD has no settings, got members"),
    ],
)
def test_settings_that_it_has_not_are_refused(tmp_path: Path, method: str, given: str, told: str) -> None:
    own = f'{method} = {{method = "{EXAMPLES}/{method}.py:METHOD", {given}}}\n'
    with pytest.raises(RecipeError, match=told):
        load_experiment(recipe(tmp_path, f'["{method}"]', own), tmp_path / "runs")


def test_one_name_is_not_two_methods(tmp_path: Path) -> None:
    add_method("mine", DELTA)
    add_method("mine", DELTA)
    other = f"{EXAMPLES}/gru_ensemble.py:METHOD"
    with pytest.raises(BadInputError, match=f"method 'mine' is {DELTA} already: give {other} another name"):
        add_method("mine", other)
    assert METHODS["mine"].title == "Delta action"


@pytest.mark.parametrize(
    ("name", "place", "told"),
    [
        ("nas", "delta_action.py:METHOD", "method 'nas' is one of the package: give .* another name"),
        ("Mine", "delta_action.py:METHOD", "method 'Mine': expected a name of a-z"),
        ("1st", "delta_action.py:METHOD", "method '1st': expected a name .* and begins with a letter"),
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


HEAD = """
from functools import partial
from pydantic import BaseModel
from astra_data.core.config import Config
from astra_data.methods.astra import DIRECT_TRANSFER
from astra_data.methods.method import Method, Table
from astra_data.policies.train import InSimulator, UserLearner
from astra_data.grounding.fit import HistoryFit
from astra_data.grounding.simulator import FittedGrounding
class Ours(Config):
    memory: int = 4
class Theirs(BaseModel):
    memory: int = 4
class Half(FittedGrounding):
    kind = "half"
class Whole(FittedGrounding):
    kind, to_file, from_file, corrected = "whole", 1, 2, 3
class Kept:
    to_file, from_file = 1, 2
def fit(fitting): ...
METHOD = partial(Method, name="", title="")(
"""


@pytest.mark.parametrize(
    ("rest", "told"),
    [
        ("fit=fit, table=Table('mine', Ours)", "has settings that nothing reads: expected configures=.ground"),
        ("table=Table('mine', Ours), configures='ground'", "has settings that nothing reads: .* needs fit"),
        (
            "fit=fit, table=Table('mine', Theirs), configures='ground'",
            r"has settings of Theirs, which is no .*Config: expected class Theirs\(Config\)",
        ),
        ("fit=fit, grounding=Half", "has a grounding, Half, without to_file, from_file"),
        ("learn=None, fit=fit, grounding=Half", "learns no policy.*; .*mine.py:METHOD has a grounding, Half, without"),
        ("grounding=Whole, grounded_as='nas'", "has grounding, grounded_as, and nothing is fitted: expected fit"),
        ("fit=fit, grounded_as='nas'", "is grounded as nas, which has another fit: expected the same"),
        ("aligns=True", "has aligns, and nothing is fitted: expected fit"),
        ("fit='fit', learn=5", r"has fit='fit': expected a function fit\(fitting\); .*mine.py:METHOD has learn=5: exp"),
        ("learn=UserLearner(learn=fit, policy=Half)", r"has learn=<function fit at .*: .* learn\(env, training\)"),
        ("fit=lambda fitting, extra: None", r"has fit=<function <lambda> at .*: expected a function fit\(fitting\)"),
        ("table=Ours", "has table=<class '.*Ours'>: expected a Table of its name in recipes and the class of its"),
        ("fit=HistoryFit(latent=True, reward=False, encoder=Kept())", "has an object as encoder: expected its class"),
        ("fit=HistoryFit(latent=True, reward=False, encoder=Kept)", "has an encoder, Kept, without kind, a string, i"),
        ("learn=InSimulator(reward='paid', ranges='all')", "has reward='paid': expected .*; .*has ranges='all': exp"),
        (
            "fit=HistoryFit(latent=True, reward=False), learn=InSimulator(reward='predicted')",
            r"is paid a reward that nothing predicts: expected HistoryFit\(reward=True\)",
        ),
        ("fit=fit, grounding=object(), table=Table('mine', Ours())", "has an object as grounding, table: expected its"),
        ("learn=UserLearner(learn=fit, policy=Kept())", "has an object as policy: expected its class"),
        ("learn=UserLearner(learn=fit, policy=Kept)", "learns a Kept, without kind, a string, act: expected the cl"),
        ("title=3", "has title=3: expected text"),
        ("color='banana'", "has the color 'banana': expected \"#rrggbb\""),
        ("role='roof'", "has role='roof': expected None, 'floor', 'ceiling', 'trained there'"),
        ("learns_from='logs', configures='grond'", "has learns_from='logs': .*; .*has configures='grond': expected 'g"),
    ],
)
def test_what_a_method_lacks_is_told_before_anything_runs(tmp_path: Path, rest: str, told: str) -> None:
    (tmp_path / "mine.py").write_text(f"{HEAD}{rest})\n")
    with pytest.raises(RecipeError, match=f"mine.py:METHOD {told}"):
        load_experiment(recipe(tmp_path, '["mine"]', f'mine = "{tmp_path}/mine.py:METHOD"\n'), tmp_path / "runs")
    assert "mine" not in METHODS
