import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor
from toy_episodes import toy_episodes
from toy_worlds import GoToZero

from astra_data.core.progress import Progress, silent
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.learning.learner import Learner
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.policy import PolicyShape
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.learning.ppo import Ppo
from astra_data.learning.recorded import Recorded
from astra_data.learning.sac import Sac
from astra_data.training.ramp import Ramp
from astra_data.training.train import (
    AnyTrainConfig,
    InSimulator,
    PpoTrainConfig,
    SacTrainConfig,
    Training,
    imitates,
    lately,
    learner_of,
    optimize,
    train_in,
)
from astra_data.worlds.registry import TASKS
from astra_data.worlds.task import Task
from astra_data.worlds.variation import PlanarVariation

TASK = TASKS["antmaze-umaze"]
PPO = PpoTrainConfig(num_envs=4, rollout_steps=4, total_steps=4 * 4 * 3, hidden_sizes=(8, 6), memory_size=5)
SAC = SacTrainConfig(
    learner="sac",
    num_envs=4,
    rollout_steps=4,
    total_steps=32,
    updates_per_step=1,
    batch_size=8,
    window=4,
    burn_in=1,
    hidden_sizes=(8,),
    memory_size=5,
)


class ToyWorld(GoToZero):
    penalty_scale = 1.0


def training(
    folder: Path,
    config: PpoTrainConfig | SacTrainConfig = PPO,
    *,
    task: Task = TASK,
    grounding: Grounding = NO_GROUNDING,
    settings: PlanarVariation | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> Training:
    torch.manual_seed(0)
    state = torch.tensor([-4.0, 4.0, 0.0, 0.0]).expand(2, 6, 4) + 0.1 * torch.randn(2, 6, 4)
    episodes = toy_episodes(
        state,
        torch.randn(2, 6, 2),
        next_state=state,
        simulated_next=state + 0.1 * torch.randn_like(state),
        goal=torch.zeros(2, 6, 2),
    )
    return Training(task, config, settings, episodes, grounding, None, seed, "cpu", folder, progress)


def grounding() -> HistoryGrounding:
    torch.manual_seed(0)
    return HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False))


def test_the_learner_that_is_named_has_the_settings_ppo_by_default() -> None:
    read: TypeAdapter[PpoTrainConfig | SacTrainConfig] = TypeAdapter(AnyTrainConfig)
    assert type(read.validate_python({})) is PpoTrainConfig
    assert type(read.validate_python({"learner": "ppo", "clip": 0.1})) is PpoTrainConfig
    sac = read.validate_python({"learner": "sac", "burn_in": 3})
    assert (type(sac), sac.num_envs) == (SacTrainConfig, 32)
    assert read.validate_python(sac) is sac
    with pytest.raises(ValidationError, match="burn_in"):
        read.validate_python({"burn_in": 3})
    with pytest.raises(ValidationError, match="ramp: expected 0 with SAC"):
        read.validate_python({"learner": "sac", "ramp": 0.5})


def test_each_learner_gets_its_policy_in_the_asked_sizes() -> None:
    shape = PolicyShape(1, 1, 5, hidden_sizes=(8, 6))
    recorded = Recorded(torch.zeros(1, 9, 1), torch.zeros(1, 9, 1), torch.zeros(1, 9, 1), torch.tensor([9]))
    given: dict[str, Any] = {"horizon": 7, "seed": 3, "recorded": recorded}
    ppo = learner_of(PPO, ToyWorld(4), shape, "cpu", **given)
    assert type(ppo) is Ppo and type(ppo.policy) is ActorCritic
    assert ppo.policy.shape == ActorCriticShape(1, 1, 5, hidden_sizes=(8, 6))
    assert (ppo.total_steps, ppo.acting.horizon) == (48, 7)
    sac = learner_of(SAC, ToyWorld(4), shape, "cpu", **given)
    assert type(sac) is Sac and type(sac.policy) is SoftActor
    assert sac.policy.shape == shape
    assert sac.acting.horizon == 7
    imitating = SAC.model_copy(update={"imitation_weight": 0.4})
    assert [imitates(config) for config in (PPO, SAC, imitating)] == [False, False, True]


@pytest.mark.parametrize("config", [PPO, SAC])
def test_the_seed_decides_the_policy(config: PpoTrainConfig | SacTrainConfig, tmp_path: Path) -> None:
    weights = []
    for number, seed in enumerate((0, 0, 1)):
        folder = tmp_path / str(number)
        folder.mkdir()
        policy, curve = train_in(ToyWorld(4), config, 5, training(folder, seed=seed), 20)
        weights.append(torch.cat([values.flatten() for values in policy.state_dict().values()]))
        assert [point["steps"] for point in curve["points"]] == list(range(16, config.total_steps + 1, 16))
        assert policy.shape.memory_size == 5
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


class Counting:
    """Stands for a learner that does nothing but count, and notes the scale of the penalties as it goes."""

    def __init__(self, env: ToyWorld, figures: Callable[[int], dict[str, float]]) -> None:
        self.env, self.figures, self.steps, self.total_steps = env, figures, 0, 10
        self.scales: list[float] = []
        self.acting = self
        self.world_seconds = 0.5

    @property
    def done(self) -> bool:
        return self.steps >= self.total_steps

    def iterate(self) -> dict[str, float]:
        self.scales.append(self.env.penalty_scale)
        self.steps += 1
        return self.figures(self.steps)

    def state_dict(self) -> dict[str, Tensor]:
        return {"steps": torch.tensor(self.steps)}

    def load_state_dict(self, state: dict[str, Tensor], observation: Tensor, *, goes_on: bool) -> None:
        self.steps, self.observation, self.goes_on = int(state["steps"]), observation, goes_on


WHOLE = Ramp()


def counted(
    given: Training, ramp: Ramp, figures: Callable[[int], dict[str, float]]
) -> tuple[Counting, dict[str, Any]]:
    env = ToyWorld(2)
    learner = Counting(env, figures)
    return learner, optimize(cast(Learner, learner), env, ramp, given)


def test_penalties_ramp_up_over_a_share_of_the_training(tmp_path: Path) -> None:
    for name, ramp, expected in (
        ("ramp", 0.4, [0.0, 0.25, 0.5, 0.75, *[1.0] * 6]),
        ("none", 0.0, [1.0] * 10),
    ):
        (tmp_path / name).mkdir()
        learner, _ = counted(training(tmp_path / name), Ramp(ramp), lambda step: {"success": 0.0})
        assert learner.scales == pytest.approx(expected)


def test_penalties_shrink_while_the_training_fails(tmp_path: Path) -> None:
    succeeding = {1, 2, 3, *range(9, 11)}
    learner, _ = counted(
        training(tmp_path), Ramp(0.5, 0.5), lambda step: {"success": float(step in succeeding) * 0.7}
    )
    # Means of five points: 0.7 until step 3, then 0.52, 0.42, 0.28, 0.14, 0 and 0.14; a step is a fifth.
    assert learner.scales == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 0.6, 0.4, 0.2, 0.0, 0.0], abs=1e-9)


def test_the_curve_has_every_iteration_and_null_for_what_is_undefined(tmp_path: Path) -> None:
    notes: list[tuple[float, str]] = []
    given = training(tmp_path, progress=lambda share, note: notes.append((share, note)))
    _, curve = counted(given, WHOLE, lambda step: {"success": math.nan if step < 3 else step / 10})
    assert [point["success"] for point in curve["points"]] == [
        None,
        None,
        *[step / 10 for step in range(3, 11)],
    ]
    assert [point["steps"] for point in curve["points"]] == list(range(1, 11))
    assert curve["simulator_steps_per_second"] == pytest.approx(10 / 0.5)
    assert [share for share, _ in notes] == pytest.approx([step / 10 for step in range(1, 11)])
    assert notes[0][1].endswith("success of training episodes unknown yet")
    assert notes[-1][1].endswith("success of training episodes 0.65")  # the mean of 0.3 to 1.0


def test_where_success_is_to_last_the_length_of_episodes_is_told_instead(tmp_path: Path) -> None:
    notes: list[str] = []
    walker = TASKS["humanoid-kinematics"]
    given = training(tmp_path, task=walker, progress=lambda share, note: notes.append(note))
    _, curve = counted(given, WHOLE, lambda step: {"success": 0.0, "episode_steps": 1000.0 * step})
    assert {point["success"] for point in curve["points"]} == {None}
    assert notes[-1].endswith("steps of training episodes 5,500")


def test_a_training_goes_on_from_its_last_checkpoint(tmp_path: Path) -> None:
    given = training(tmp_path)
    first, _ = counted(given, WHOLE, lambda step: {"success": 0.5})
    assert (tmp_path / "checkpoint.safetensors").is_file()
    env = ToyWorld(2)
    again = Counting(env, lambda step: {"success": 0.5})
    again.total_steps = 12
    curve = optimize(cast(Learner, again), env, WHOLE, given)
    assert again.scales == [1.0, 1.0] and again.goes_on
    assert torch.equal(again.observation, first.env.observe())
    assert [point["steps"] for point in curve["points"]] == list(range(1, 13))
    assert curve["simulator_steps_per_second"] == pytest.approx(2 / 0.5)
    ended = Counting(env, lambda step: {"success": 0.5})
    ended.total_steps = 12
    curve = optimize(cast(Learner, ended), env, WHOLE, given)
    assert len(curve["points"]) == 12 and curve["simulator_steps_per_second"] is None


def test_the_episodes_of_robots_do_not_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToyWorld, "state_dict", lambda world: {})
    monkeypatch.setattr(ToyWorld, "load_state_dict", lambda world, state: world.observe())
    given = training(tmp_path)
    counted(given, WHOLE, lambda step: {"success": 0.5})
    again = Counting(ToyWorld(2), lambda step: {"success": 0.5})
    optimize(cast(Learner, again), again.env, WHOLE, given)
    assert again.steps == 10 and not again.goes_on


def test_a_recipe_decides_the_reward_before_the_method(tmp_path: Path) -> None:
    for asked, methods, expected in (
        (None, "abstract", "abstract"),
        (None, "predicted", "predicted"),
        ("blend", "predicted", "blend"),
    ):
        config = PPO.model_copy(update={"reward": asked})
        env, simulation = InSimulator(reward=methods).world(training(tmp_path, config, grounding=grounding()))  # type: ignore[arg-type]
        assert (env.reward, simulation.world.reward) == (expected, expected)


def test_switches_reach_the_environment_and_the_policy_file(tmp_path: Path) -> None:
    switches = {
        "num_envs": 3,
        "topple": True,
        "risk_weight": 2.0,
        "residual_noise": 0.5,
        "support_penalty": 0.2,
        "disagreement_penalty": 0.3,
        "change_penalty": 0.1,
        "command_limit": 0.7,
        "data_start_share": 0.6,
    }
    given = training(tmp_path, PPO.model_copy(update=switches))
    env, simulation = InSimulator().world(given)
    assert (env.num_envs, env.topple, env.risk_weight, env.disagreement_penalty) == (3, True, 2.0, 0.3)
    assert (env.command_limit, env.data_start_share, env.change_penalty) == (0.7, 0.6, 0.1)
    assert simulation.thinness is not None and env.thinness is not None
    torch.testing.assert_close(env.thinness, 0.2 * simulation.thinness)
    expected = 0.5 * NO_GROUNDING.scatter(given.episodes)
    torch.testing.assert_close(simulation.scatter, expected)
    assert env.simulator.scatter is simulation.scatter
    assert (
        simulation.world.model_dump().items()
        >= {"topple": True, "disagreement_penalty": 0.3, "data_start_share": 0.6}.items()
    )


def test_parameters_vary_as_the_method_says_unless_its_settings_do(tmp_path: Path) -> None:
    own = PlanarVariation(friction=(0.5, 0.6))
    for ranges, settings, expected in (
        (None, None, None),
        ("randomized", None, TASK.varied.randomized),
        ("wide", None, TASK.varied.wide),
        ("wide", own, own),
    ):
        given = training(tmp_path, settings=settings)
        env, simulation = InSimulator(ranges=ranges).world(given, shows_parameters=True)  # type: ignore[arg-type]
        assert simulation.variation == expected
        assert env.parameter_count == (0 if expected is None else len(own.names))


def test_policies_that_observe_latents_have_no_memory(tmp_path: Path) -> None:
    config = PPO.model_copy(update={"episode_steps": 3})
    for name, used, memory_size, observed in (("raw", NO_GROUNDING, 5, 8), ("latents", grounding(), 0, 16)):
        (tmp_path / name).mkdir()
        trained, curve = InSimulator()(training(tmp_path / name, config, grounding=used))
        shape = trained.policy.shape
        assert (shape.memory_size, shape.observation_size, shape.hidden_sizes) == (
            memory_size,
            observed,
            (8, 6),
        )
        assert trained.simulation is not None and (trained.dataset, trained.content_hash) == (
            "toy@data-1.0.0",
            "0",
        )
        assert max(point["episode_steps"] or 0 for point in curve["points"]) <= 3


def test_simulated_episodes_last_as_long_as_the_tasks_unless_told_otherwise(tmp_path: Path) -> None:
    given = training(tmp_path)
    assert given.simulated_steps == TASK.objective.horizon
    assert replace(given, config=PPO.model_copy(update={"episode_steps": 9})).simulated_steps == 9


def test_what_was_recorded_is_imitated_where_the_learner_imitates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Recorded | None] = []

    def note(*_: object, recorded: Recorded | None = None) -> None:
        seen.append(recorded)
        raise InterruptedError

    monkeypatch.setattr("astra_data.training.train.train_in", lambda *given: note(recorded=given[-1]))
    for config in (PPO, SAC, SAC.model_copy(update={"imitation_weight": 0.4})):
        with pytest.raises(InterruptedError):
            InSimulator()(training(tmp_path, config, grounding=grounding()))
    assert seen[:2] == [None, None]
    recorded = seen[2]
    assert recorded is not None and recorded.observation.shape == (2, 6, 8 + 8)
    episodes = training(tmp_path).episodes
    latent, _ = grounding().model.encode(episodes.windows)
    torch.testing.assert_close(recorded.observation[..., :8], latent / 8**0.5)
    assert torch.equal(recorded.action, episodes.windows.action)
    assert torch.equal(recorded.previous_action, episodes.windows.previous_action)
    assert recorded.lengths.tolist() == [6, 6]


def test_what_is_told_on_the_way_is_of_the_last_ten_points() -> None:
    points = [{"success": value} for value in (*[0.0] * 5, *[1.0] * 9, None)]
    assert lately(points, "success").endswith("1.00")
    assert lately(points[:-1], "success").endswith("0.90")
