import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from spending import SPENT, spend
from stopping import Stopped, stop_past
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.core.config import Config, load_recipe, validated
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.progress import Progress, silent
from astra_data.experiments.plan import plan
from astra_data.experiments.recipe import Recipe
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.causal import CausalConfig, CausalModel, fit_causes
from astra_data.methods import compass
from astra_data.methods.compass import CompassConfig, Search, identify
from astra_data.worlds.registry import TASKS
from astra_data.worlds.task import Task
from astra_data.worlds.variation import WIDE_RANGES, PlanarVariation, Variation

TASK = TASKS["antmaze-umaze"]
PLANTED = {"friction": 0.92, "action_scale": 0.05, "timestep_scale": 1.1, "heading_bias_deg": 3.0}
QUICK = CompassConfig(
    **WIDE_RANGES.model_dump()
    # No more noise than leaves the planted gap of 3 cm to be seen.
    | {"action_noise": (0.0, 0.0), "position_noise_m": (0.0, 0.002), "velocity_noise_m_s": (0.0, 0.002)},
    contexts=64,
    windows=60,
    window=15,
    updates=400,
    iterations=3,
)


def record(task: Task, planted: Variation, seed: int, episodes: int = 16, steps: int = 60) -> PairedEpisodes:
    """Drive simulators with planted parameters by commands that are held for 15 steps."""
    torch.manual_seed(seed)
    target = task.varied_simulator(episodes, planted)
    if task.plane:
        start = torch.tensor(task.maze.cell_center(*task.maze.start), dtype=torch.float32)
        target.reset_to(torch.cat([start, torch.zeros(2)]).repeat(episodes, 1))
    held = torch.rand(episodes, steps // 15, task.objective.action_size) * 2.0 - 1.0
    action = held.repeat_interleave(15, dim=1)
    state = torch.stack([target.state, *(target.step(action[:, step]) for step in range(steps))], dim=1)
    return toy_episodes(state[:, :-1], action, next_state=state[:, 1:])


def fitting(
    folder: Path,
    settings: Config | None = QUICK,
    progress: Progress = silent,
    task: Task = TASK,
    planted: Mapping[str, float] = PLANTED,
) -> Fitting:
    variation = type(task.varied.wide)(**{name: (value, value) for name, value in planted.items()})
    training, held_out = (record(task, variation, seed, episodes) for seed, episodes in enumerate((16, 4)))
    return Fitting(task, GroundConfig(), settings, training, held_out, 0, "cpu", folder, progress)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Variation, dict[str, Any]]:
    grounding, metrics = identify(fitting(tmp_path_factory.mktemp("compass")))
    return grounding.variation, metrics


def test_planted_parameters_are_found(found: tuple[Variation, dict[str, Any]]) -> None:
    variation, metrics = found
    point = metrics["point"]
    speed = point["friction"] * (1.0 + point["action_scale"])
    assert speed == pytest.approx(0.92 * 1.05, rel=0.02)
    assert speed * point["timestep_scale"] == pytest.approx(0.92 * 1.05 * 1.1, rel=0.02)
    assert point["heading_bias_deg"] == pytest.approx(3.0, abs=1.0)
    before, after = metrics["held_out_gap"]["plain"], metrics["held_out_gap"]["identified"]
    assert after["position_m"] < 0.25 * before["position_m"]
    assert after["velocity_m_s"] < 0.4 * before["velocity_m_s"]
    for name, value in point.items():
        assert getattr(variation, name) == (value, value)
    # Noise cannot be identified: it keeps its ranges.
    for name in PlanarVariation().names:
        if name not in point:
            assert getattr(variation, name) == getattr(QUICK, name)


def test_planted_joints_are_found(tmp_path: Path) -> None:
    task = TASKS["humanoid-kinematics"]
    planted = {"friction": 1.15, "action_scale": 0.03, "timestep_scale": 1.3}
    wide = task.varied.wide.model_copy(update={"action_noise": (0.0, 0.0)})
    settings = CompassConfig(
        **wide.model_dump(), contexts=32, windows=30, window=10, updates=600, iterations=3
    )
    grounding, metrics = identify(fitting(tmp_path, settings, task=task, planted=planted))
    point = metrics["point"]
    assert point["action_scale"] == pytest.approx(0.03, abs=0.01)
    assert point["timestep_scale"] == pytest.approx(1.3, abs=0.05)
    # Of all that holds a joint back, the motor's own damping is most.
    assert point["friction"] == pytest.approx(1.15, abs=0.1)
    # The scale of what is shown is not asked about, and drawn from its range while the policy is trained.
    assert metrics["mask"].keys() == planted.keys()
    ends = {name: (value, value) for name, value in point.items()}
    assert grounding.variation == wide.model_copy(update=ends)


def test_the_mask_tells_causes_from_bystanders(found: tuple[Variation, dict[str, Any]]) -> None:
    mask = found[1]["mask"]
    # Only parameters that vary are asked about.
    assert mask.keys() == {*PLANTED, "position_noise_m", "velocity_noise_m_s"}
    for relevant in ("friction", "action_scale", "timestep_scale"):
        assert mask[relevant]["position_m"] > 0.7
        assert mask["position_noise_m"]["position_m"] < QUICK.mask_threshold
        assert mask["velocity_noise_m_s"]["position_m"] < QUICK.mask_threshold
    # The same velocity, held for longer, is no other velocity.
    assert mask["timestep_scale"]["velocity_m_s"] < QUICK.mask_threshold < mask["friction"]["velocity_m_s"]


def test_after_an_interruption_it_goes_on(tmp_path: Path) -> None:
    settings = QUICK.model_copy(update={"contexts": 8, "updates": 20, "iterations": 4})
    for name in ("whole", "interrupted"):
        (tmp_path / name).mkdir()
    whole, expected = identify(fitting(tmp_path / "whole", settings))
    with pytest.raises(Stopped):
        identify(fitting(tmp_path / "interrupted", settings, stop_past(0.49)))
    spend(tmp_path / "interrupted" / "checkpoint.safetensors")
    seen: list[str] = []
    resumed, metrics = identify(
        fitting(tmp_path / "interrupted", settings, lambda _, note: seen.append(note))
    )
    assert len(seen) == 2 and "replays/s  held-out gap 0." in seen[0]
    assert resumed == whole
    assert metrics["iterations"] == expected["iterations"]
    assert all(seconds < metrics[clock] < seconds + 500 for clock, seconds in SPENT.items())
    assert metrics["replays_per_second"] == pytest.approx(4 * 8 * 60 / metrics["wall_seconds"], rel=0.01)


@pytest.mark.parametrize("better", [True, False])
def test_the_point_moves_only_to_where_replays_come_closer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, better: bool
) -> None:
    """Whatever the causal model expects: here it is asked for the planted parameters, or for the corner."""
    steering = {"friction": 0.92, "action_scale": 0.05, "timestep_scale": 1.1, "heading_bias_deg": 3.0}
    plain = {"friction": 1.0, "action_scale": 0.0, "timestep_scale": 1.0, "heading_bias_deg": 0.0}
    names = [name for name in QUICK.of_kind(PlanarVariation).names if name in _varied(QUICK)]

    def answer(model: object, mask: object, start: Tensor, moves: Tensor, others: object) -> Tensor:
        assert [name for name, moving in zip(names, moves, strict=True) if moving] == [
            name for name in names if name in steering
        ]
        there = torch.full_like(start, -1.0)
        for index, name in enumerate(names):
            if better and name in steering:
                low, high = getattr(QUICK, name)
                there[index] = 2 * (steering[name] - low) / (high - low) - 1
        return there

    monkeypatch.setattr(compass, "descend", answer)
    settings = QUICK.model_copy(update={"contexts": 4, "updates": 5, "iterations": 1, "mask_threshold": 0.0})
    _, metrics = identify(fitting(tmp_path, settings))
    assert metrics["point"] == pytest.approx(steering if better else plain, abs=1e-5)


def _varied(settings: CompassConfig) -> list[str]:
    return [
        name for name, (low, high) in settings.of_kind(PlanarVariation).model_dump().items() if low < high
    ]


def test_the_box_is_drawn_in_around_the_point(tmp_path: Path) -> None:
    search = Search.begin(
        PlanarVariation(friction=(0.9, 1.3), heading_bias_deg=(2.0, 10.0)), tmp_path / "none"
    )
    # From the plain simulator, or the end of the range that is next to it.
    assert search.point["friction"] == 1.0 and search.point["heading_bias_deg"] == 2.0
    search.narrow(["friction", "heading_bias_deg"], 0.5)
    assert search.box.model_dump()["friction"] == pytest.approx((0.9, 1.1))
    assert search.box.model_dump()["heading_bias_deg"] == pytest.approx((2.0, 4.0))
    assert search.box.model_dump()["timestep_scale"] == (1.0, 1.0)


def test_windows_with_the_largest_gaps_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = QUICK.model_copy(
        update={"contexts": 4, "updates": 5, "iterations": 1, "windows": 40, "outlier_share": 0.1}
    )
    told: list[tuple[Tensor, Tensor]] = []

    def fit(cause: Tensor, effect: Tensor, config: CausalConfig, *, penalized: int) -> CausalModel:
        told.append((cause, effect))
        assert penalized == 6
        return fit_causes(cause, effect, config, penalized=penalized)

    monkeypatch.setattr(compass, "fit_causes", fit)
    identify(fitting(tmp_path, settings))
    cause, effect = told[0]
    # 4 of 40 in each of two quantities at most, in each of four contexts.
    assert 4 * 32 <= len(effect) <= 4 * 36
    assert cause.shape[1] == 6 + 2 + 2  # parameters; first velocity and mean command
    # What is to be explained is what the parameters change, of deviation 1 in each quantity.
    windows = effect.view(4, -1, 2)
    torch.testing.assert_close(effect.std(0), torch.ones(2), rtol=1e-3, atol=1e-3)
    assert windows.mean(0).abs().max() < 1e-4
    # Parameters are the same in all windows of a context, and windows in all contexts.
    causes = cause.view(4, -1, 10)
    assert (causes[..., :6] == causes[:, :1, :6]).all() and (causes[..., 6:] == causes[:1, :, 6:]).all()


def test_around_the_point_is_within_the_ranges(
    found: tuple[Variation, dict[str, Any]], tmp_path: Path
) -> None:
    fixed = {"friction": (1.0, 1.0), "heading_bias_deg": (0.0, 0.0)}
    settings = QUICK.model_copy(update={"policy_at": "around", "contexts": 32, "iterations": 1, **fixed})
    grounding, metrics = identify(fitting(tmp_path, settings))
    variation = grounding.variation
    assert isinstance(variation, PlanarVariation)
    low, high = variation.timestep_scale
    assert 0.75 <= low < metrics["point"]["timestep_scale"] < high <= 1.25
    assert high - low <= 0.6 * (1.25 - 0.75) + 1e-6
    assert variation.friction == (1.0, 1.0) and variation.velocity_noise_m_s == QUICK.velocity_noise_m_s


def test_what_cannot_be_identified_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="expected episodes of at least 61 steps, the longest has 60: sh"):
        identify(fitting(tmp_path, QUICK.model_copy(update={"window": 61})))
    fixed = {name: (1.0, 1.0) for name in PLANTED}
    with pytest.raises(BadInputError, match="expected a range for at least one of friction"):
        identify(fitting(tmp_path, QUICK.model_copy(update=fixed)))


def test_both_rows_read_the_same_table(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    path.write_text(
        'task = "antmaze-umaze"\nmethods = ["compass", "compass_uniform", "compass_plus"]\nseeds = [0]\n'
        "[compass]\nfriction = [0.5, 0.9]\nwindow = 10\n"
    )
    items = {item.key: item.call.keywords for item in plan(load_recipe(path, Recipe), path, tmp_path)}  # type: ignore[attr-defined]
    assert items["ground/compass/seed_0"]["settings"].window == 10
    assert items["ground/compass/seed_0"]["settings"].friction == (0.5, 0.9)
    uniform = items["train/compass_uniform/seed_0"]["settings"]
    assert uniform == PlanarVariation(**{**WIDE_RANGES.model_dump(), "friction": (0.5, 0.9)})
    assert items["train/compass/seed_0"]["settings"] is None
    assert items["train/compass_plus/seed_0"]["grounding"] == tmp_path / "ground/compass/seed_0"


def ranges(task: str, tables: str) -> Recipe:
    text = f'task = "{task}"\nmethods = ["compass"]\nseeds = [0]\n[collect]\nstart = "task"\n{tables}'
    return validated(tomllib.loads(text), Recipe, "r.toml")


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_ranges_are_laid_over_those_of_the_task(task: Task) -> None:
    usual = ranges(task.name, "")
    assert usual.settings_of("compass_uniform", "train") == task.varied.wide
    assert usual.settings_of("domain_randomization", "train") == task.varied.randomized
    assert Recipe.model_validate(usual.model_dump()) == usual
    own = ranges(
        task.name, "[compass]\nfriction = [0.5, 0.9]\n[domain_randomization]\naction_noise = [0.0, 0.2]\n"
    )
    assert own.settings_of("compass_uniform", "train") == task.varied.wide.model_copy(
        update={"friction": (0.5, 0.9)}
    )
    randomized = task.varied.randomized.model_copy(update={"action_noise": (0.0, 0.2)})
    assert own.settings_of("domain_randomization", "train") == randomized


def test_ranges_that_the_simulator_does_not_have_are_refused() -> None:
    known = "friction, action_scale, action_noise, observation_scale, timestep_scale"
    other = "ball_friction = [0.5, 1.5]\nheading_bias_deg = [-5, 5]\n"
    for table in ("compass", "domain_randomization"):
        with pytest.raises(RecipeError) as caught:
            ranges("humanoid-walker2d", f"[{table}]\n{other}")
        found = "got one of heading_bias_deg, ball_friction"
        assert str(caught.value) == f"r.toml: {table}: expected ranges of {known}, {found}"
        with pytest.raises(RecipeError, match=f"{table}.frction: unknown key: did you mean 'friction'"):
            ranges("antmaze-umaze", f"[{table}]\nfrction = [1.0, 1.0]")
        with pytest.raises(RecipeError, match=f"^r.toml: {table}.friction: expected a range above 0, got"):
            ranges("antmaze-umaze", f"[{table}]\nfriction = [0.0, 1.0]")
    # Plain ones do no harm: what records older recipes lists them all.
    assert ranges("antmaze-umaze", "[compass]\nball_friction = [1.0, 1.0]\n")
