"""Grounded-v0 and policies of other learners, on a run of a user's own cart and on one in a maze."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import astra_data.envs
from astra_data.cli.app import app
from astra_data.core.artifact import read_manifest, write_manifest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.grounding.files import load_target_encoder, save_target_encoder
from astra_data.pipeline import grounded_env
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.grounded_env import OPTIONS, evaluate_policy
from astra_data.pipeline.plan import plan
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.trained_policy import load_policy, settings_of
from astra_data.policies.gymnasium import Array, BatchedVectorEnv, SingleEnv
from astra_data.policies.networks import UserPolicy
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.train import InSimulator
from astra_data.worlds.user_code import user_object

gymnasium.register_envs(astra_data.envs)
ID = "astra_data/Grounded-v0"
EXAMPLES = Path(__file__).parents[2] / "recipes/examples"


@pytest.fixture(scope="module")
def run(cart: Path) -> Path:
    """The folder of the cart's run, of a recipe with one row more."""
    recipe = cart / "cart.toml"
    recipe.write_text(recipe.read_text().replace('"astra"', '"astra", "astra_plus"'))
    experiment = load_experiment(recipe, cart / "runs")
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    return experiment.folder


def world_of(run: Path, row: str, **options: Any) -> SimulatorEnv:
    """Return what Grounded-v0 wraps, as `train` builds it."""
    env = gymnasium.make(ID, run=run, row=row, **options).unwrapped
    assert isinstance(env, SingleEnv)
    world: SimulatorEnv = env.env.env  # type: ignore[union-attr]
    return world


@pytest.mark.filterwarnings("ignore:.*infinity")
@pytest.mark.parametrize(
    ("row", "size"), [("direct_transfer", 2), ("nas", 2 + 4), ("astra", 2 + 4), ("astra_plus", 2 + 4)]
)
def test_gymnasiums_own_checks_pass_for_a_task_of_ones_own(run: Path, row: str, size: int) -> None:
    env = gymnasium.make(ID, run=str(run), row=row, seed=0)
    assert env.observation_space.shape == (size,) and env.action_space == gymnasium.spaces.Box(-1, 1, (2,))
    check_env(env.unwrapped, skip_render_check=True)


def test_direct_transfer_is_the_raw_simulator_driven_in_its_units(run: Path) -> None:
    env = gymnasium.make(ID, run=run, row="direct_transfer")
    (ahead, left), _ = env.reset(seed=3)
    seen = np.array([ahead, left]) * 3.0
    assert np.hypot(*seen) == pytest.approx(3.0, rel=1e-5)
    observation, reward, *_ = env.step(np.array([1.0, 0.0], dtype=np.float32))
    # +1 of v's bounds (-0.2, 1.0) m/s over 0.1 s, and 0 of w's: 0.1 m ahead.
    np.testing.assert_allclose(observation * 3.0, seen - [0.1, 0.0], atol=1e-5)
    nearer = 3.0 - np.hypot(seen[0] - 0.1, seen[1])
    assert reward == pytest.approx(nearer, abs=1e-5)


def test_the_row_and_the_recipe_give_the_defaults_and_keywords_change_them(run: Path) -> None:
    plain, predicted, plus = (world_of(run, row) for row in ("nas", "astra", "astra_plus"))
    assert (plain.world.reward, predicted.world.reward, plus.world.reward) == ("abstract", "predicted", "priced")
    assert (plain.world.change_penalty, plus.world.change_penalty) == (0.0, 0.02)
    assert plain.world.data_start_share == plus.world.data_start_share == 0.0 and plain.starts is None
    changed = world_of(run, "nas", data_start_share=1.0)
    assert changed.world.data_start_share == 1.0 and changed.starts is not None


def test_it_is_the_environment_that_the_row_was_trained_in(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[SimulatorEnv] = []
    build = InSimulator.world

    def kept(self: InSimulator, training: Any, **more: Any) -> Any:
        made = build(self, training, **more)
        built.append(made[0])
        return made

    monkeypatch.setattr(InSimulator, "world", kept)
    experiment = load_experiment(run.parents[1] / "cart.toml", run.parent)
    items = {item.key: item for item in plan(experiment.recipe, experiment.path, run)}
    call: Any = items["train/astra_plus/seed_0"].call
    config = call.keywords["config"].model_copy(update={"data_start_share": 0.25})
    call(config=config, out=run.parents[1] / "again")
    trained, ours = built[0], world_of(run, "astra_plus", seed=0, data_start_share=0.25)
    plain = (str, float, int, bool)
    switches = {name: value for name, value in vars(trained).items() if isinstance(value, plain)}
    assert {name: vars(ours)[name] for name in switches} == switches | {"num_envs": 1, "penalty_scale": 1.0}
    assert trained.starts is not None and ours.starts is not None
    assert torch.equal(trained.starts.state, ours.starts.state)


@pytest.mark.usefixtures("forgotten_methods")
def test_methods_of_the_run_s_own_are_added_when_it_is_opened(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fresh process knows none of them."""
    (tmp_path / "mine.py").write_text("from astra_data.methods import METHODS\nMETHOD = METHODS['direct_transfer']\n")
    own = {"mine": f"{tmp_path}/mine.py:METHOD"}
    settings = settings_of(run) | {"user_methods": own, "methods": ["direct_transfer", "mine"]}
    monkeypatch.setattr(grounded_env, "settings_of", lambda _: settings)
    mine, raw = (gymnasium.make(ID, run=run, row=row) for row in ("mine", "direct_transfer"))
    np.testing.assert_array_equal(mine.reset(seed=3)[0], raw.reset(seed=3)[0])


def test_episodes_end_at_the_horizon_or_where_an_option_says(run: Path) -> None:
    def steps(**options: Any) -> int:
        env = gymnasium.make(ID, run=run, row="nas", **options)
        env.reset(seed=0)
        back = np.array([-1.0, 0.0], dtype=np.float32)
        for number in range(1, 1000):
            if env.step(back)[3]:
                return number
        raise AssertionError

    env = gymnasium.make(ID, run=run, row="nas", episode_steps=2).unwrapped
    ends = [env.reset() and [env.step(np.zeros(2, dtype=np.float32))[3] for _ in range(2)] for _ in range(2)]
    assert ends == [[False, True], [False, True]]
    assert (steps(), steps(episode_steps=7), steps(max_episode_steps=5)) == (60, 7, 5)
    make: Callable[..., Any] = gymnasium.make_vec
    limits: list[dict[str, int]] = [{}, {"max_episode_steps": 6}, {"max_episode_steps": 400}]
    vectors = [make(ID, num_envs=3, run=run, row="nas", **more) for more in limits]
    assert [env.max_episode_steps for env in vectors] == [60, 6, 60]
    assert all(isinstance(env, BatchedVectorEnv) for env in vectors)


def test_a_vector_and_a_single_environment_are_the_same_and_noise_repeats(run: Path) -> None:
    options: dict[str, Any] = {"run": run, "row": "nas"}
    make: Any = gymnasium.make
    many, one = gymnasium.make_vec(ID, num_envs=1, **options), make(ID, **options)
    simulator: Any = world_of(run, "nas").simulator
    assert simulator.scatter_model is not None
    action = np.array([0.5, 0.2], dtype=np.float32)

    def seen(env: Any, actions: Array) -> Array:
        return np.stack([env.reset(seed=5)[0], *(env.step(actions)[0] for _ in range(5))])

    single = seen(one, action)
    np.testing.assert_array_equal(seen(many, action[None])[:, 0], single)
    torch.rand(3)
    np.testing.assert_array_equal(seen(one, action), single)


def test_what_does_not_fit_is_answered_by_a_line(run: Path, tmp_path: Path) -> None:
    make: Callable[..., Any] = gymnasium.make

    def refused(message: str, **options: Any) -> None:
        with pytest.raises(AstraDataError, match=message) as raised:
            make(ID, **{"run": run, "row": "nas"} | options)
        assert "\n" not in str(raised.value)

    refused("unknown method 'nass'", row="nass")
    refused("iql is not trained in a simulator: .* direct_transfer for the raw simulator", row="iql")
    refused(r"the run has no seed 3; its seeds: 0", seed=3)
    refused("the recipe has no size 50", percent=50)
    refused("unknown option 'episode_step': did you mean 'episode_steps'", episode_step=3)
    refused("unknown option 'reward'", reward="abstract")
    refused("data_start_share: expected less than or equal to 1, got 2", data_start_share=2.0)
    settings = json.loads((run / "recipe.json").read_text())
    (tmp_path / "recipe.json").write_text(json.dumps(settings | {"sweep": {"percent": [50, 100]}}))
    refused(r"has several sizes: expected percent, one of \[50, 100\]", run=tmp_path)
    assert OPTIONS == ("data_start_share", "episode_steps")


class OurPolicyAgain:
    """The run's own network, behind the protocol."""

    def __init__(self, run: Path, row: str) -> None:
        self.network, self.seen = load_policy(run, row).policy, []  # type: ignore[var-annotated]

    def act(self, observation: Array) -> Array:
        self.seen.append(observation)
        features, _ = self.network.remember(
            torch.from_numpy(observation), torch.zeros(len(observation), 2), torch.zeros(len(observation), 0)
        )
        return self.network.act(features).numpy()


def test_a_rows_own_network_behind_the_protocol_has_the_rows_figures(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, read = OurPolicyAgain(run, "astra"), Mock(wraps=settings_of)
    monkeypatch.setattr(grounded_env, "settings_of", read)
    evaluate_policy(run, "astra", policy, out=tmp_path / "own")
    read.assert_called_once_with(run)
    experiment = load_experiment(run.parents[1] / "cart.toml", run.parent)
    items = {item.key: item for item in plan(experiment.recipe, experiment.path, run)}
    items["evaluate/astra/seed_0"].call(out=tmp_path / "row")
    own, row = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in ("own", "row"))
    for simulator in ("simulated", "raw", "grounded"):
        assert own[simulator] == row[simulator]
    assert own["dataset_hash"] == row["dataset_hash"] and own["policy"] == "OurPolicyAgain"
    assert {observation.shape for observation in policy.seen} == {(3, 2 + 4)}


def test_in_a_target_latents_come_from_the_aligned_encoder(run: Path, tmp_path: Path) -> None:
    task = f"{EXAMPLES}/cart/robot.py:TASK"  # the cart with a target
    settings = json.loads((run / "recipe.json").read_text())
    moved = tmp_path / "cart"
    moved.mkdir()
    for stage in ("pair", "ground", "align", "train"):
        (moved / stage).symlink_to(run / stage)
    tested = settings["evaluate"] | {"encoder": "target"}
    (moved / "recipe.json").write_text(json.dumps(settings | {"task": task, "evaluate": tested}))
    evaluate_policy(moved, "astra", OurPolicyAgain(run, "astra"), out=tmp_path / "own")
    parts = {"policy": "train", "grounding": "ground", "target_encoder": "align"}
    inputs: dict[str, Any] = {name: run / stage / "astra/seed_0" for name, stage in parts.items()}
    evaluate(task, "astra", EvaluateConfig(episodes=3, encoder="target"), **inputs, out=tmp_path / "row")
    own, row = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in ("own", "row"))
    assert own["target"] == row["target"] and own["encoders"] == row["encoders"] and own["encoder"] == "target"


@pytest.mark.parametrize(("latent_r2", "deployed"), [(0.89, False), (0.95, True)])
def test_a_policy_is_deployed_with_the_encoder_that_explains_the_latents(
    run: Path, tmp_path: Path, latent_r2: float, deployed: bool
) -> None:
    moved = Path(shutil.copytree(run, tmp_path / "cart"))
    file = moved / "align/astra/seed_0/target_encoder.safetensors"
    encoder = load_target_encoder(file)
    encoder.latent_r2.fill_(latent_r2)
    save_target_encoder(file, encoder)
    manifest = read_manifest(file.parent)
    assert manifest is not None
    write_manifest(file.parent, manifest.made_from)
    assert (load_policy(moved, "astra").target_encoder is not None) == deployed


def test_a_policy_that_gives_no_actions_is_named(run: Path, tmp_path: Path) -> None:
    class Wide:
        def act(self, observation: Array) -> Array:
            return observation

    with pytest.raises(BadInputError, match=r"Wide\.act: expected actions of shape \(3, 2\), got \(3, 6\)"):
        evaluate_policy(run, "nas", Wide(), out=tmp_path / "own")
    assert not (tmp_path / "own").exists()


def test_the_example_learns_and_is_tested_by_the_command_line(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(EXAMPLES / "random_search.py", tmp_path)
    user_object("random_search.py:learn")(run, "nas", rounds=4)
    returns = [float(line.split()[3].rstrip(",")) for line in capsys.readouterr().out.splitlines()]
    assert len(returns) == 4 and returns[-1] > returns[0] + 1.0
    shutil.copy("random_search.py", "learned.py")
    given = ["evaluate", "cart.toml", "--root", str(run.parent), "--method", "nas", "--seed", "0"]
    out = tmp_path / "tested"
    app([*given, "--policy", "learned.py:POLICY", "--out", str(out)], standalone_mode=False)
    tested = json.loads((out / "evaluation.json").read_text())
    assert tested["policy"] == "Linear" and len(tested["grounded"]["success"]) == 3
    observation = torch.ones(1, 2 + 4)
    by_hand = np.tanh(np.ones((1, 2 + 4)) @ np.load("linear.npy"))
    acted = UserPolicy(user_object("learned.py:POLICY"), 6, 2).act(observation)
    np.testing.assert_allclose(acted, by_hand, atol=1e-6)


def test_the_command_says_what_a_policy_of_ones_own_is_given_with(tmp_path: Path) -> None:
    policy, out = ["--policy", "mine.py:POLICY"], ["--out", str(tmp_path / "tested")]
    one = ["--method", "nas", "--seed", "0"]
    for given in (
        policy,
        [*policy, *one],
        [*policy, *out, "--seed", "0"],
        [*policy, *out, *one, "--seed", "1"],
        [*policy, *out, *one, "--method", "astra"],
    ):
        with pytest.raises(BadInputError, match="with --policy, give one --method, one --seed and --out"):
            app(["evaluate", "cart.toml", *given], standalone_mode=False)


def test_a_policy_needs_what_its_row_is_tested_with(run: Path, tmp_path: Path) -> None:
    moved = tmp_path / "cart"
    moved.mkdir()
    for stage in ("recipe.json", "pair", "ground"):
        (moved / stage).symlink_to(run / stage)
    with pytest.raises(BadInputError, match=r"expected .*align/astra/seed_0: run the recipe first"):
        evaluate_policy(moved, "astra", OurPolicyAgain(run, "astra"), out=tmp_path / "own")
