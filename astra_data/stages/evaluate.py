"""Evaluate: run a policy in the target environment, and in the world that it was trained in."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from astra_data.checkpoint import finished_folder, save_tensors
from astra_data.deployment import DeployedPolicy, EncoderKind
from astra_data.errors import BadInputError
from astra_data.grounding_file import Grounding, load_grounding
from astra_data.methods import method_named
from astra_data.methods.follower import CarefulFollower
from astra_data.policy_file import PolicyFile, Simulation, deploy
from astra_data.progress import Progress
from astra_data.recipe import Config, Count, Positive
from astra_data.results.provenance import origin
from astra_data.seeding import derive
from astra_data.target_encoder_file import load_target_encoder
from astra_data.tasks import Task, task_named
from astra_data.training_world import WorldParts, training_world

Act = Callable[[Tensor, Tensor], Tensor]


class EvaluateConfig(Config):
    """How policies are tested; 100 episodes are the paper's."""

    episodes: Count = 100
    """Run side by side, in the target and in simulation each."""
    encoder: EncoderKind = "target"
    """Whose latents an aligned policy is deployed with for the headline figures; both are reported."""
    leg_scale: Positive = 1.0
    """Of the ant in the target environment; 1.25 is the paper's morphology test."""


@dataclass(frozen=True)
class Outcome:
    """What happened in N episodes: a list per quantity, and every path.

    Attributes:
        success: 1 or 0.
        topple: 1 or 0.
        wall_contact: share of the steps.
        steps: until the end.
        returns: sum of rewards.
        position: (N, T + 1, 2) in m, from the start on, NaN after the end.
    """

    success: list[float]
    topple: list[float]
    wall_contact: list[float]
    steps: list[int]
    returns: list[float]
    position: Tensor

    def to_json(self) -> dict[str, list[float]]:
        """Return the lists by name."""
        return {
            "success": self.success,
            "topple": self.topple,
            "wall_contact": self.wall_contact,
            "steps": [float(steps) for steps in self.steps],
            "return": self.returns,
        }


def evaluate(
    task: str,
    method: str,
    config: EvaluateConfig,
    *,
    policy: Path | None,
    grounding: Path | None,
    target_encoder: Path | None,
    seed: int,
    out: Path,
    progress: Progress,
    num_threads: int | None = None,
) -> None:
    """Test a row and write its figures and paths to `out`.

    Starts, goals and headings depend on the seed alone, so they are the same for every method.
    The physics runs on `num_threads`, by default one per core; the outcome is the same with any number.

    Raises:
        BadInputError: an input is not there or not what was expected.
    """
    world, base = task_named(task), method_named(method)
    if base.trains and policy is None:
        raise BadInputError(f"method '{method}' has a policy to test: run the stage `train` first")
    if base.grounds and grounding is None:
        raise BadInputError(f"method '{method}' needs its grounding: run the stage `ground` first")
    began = time.perf_counter()
    told: dict[str, Any] = {"task": task, "method": method, "seed": seed, "episodes": config.episodes}
    told |= origin()
    tensors: dict[str, Tensor] = {}
    if policy is None:
        outcome, rate = _in_target(world, None, config, seed, num_threads, progress)
        tensors |= {"target.position": outcome.position}
        told |= {"target": outcome.to_json(), "target_steps_per_second": rate}
    else:
        trained = PolicyFile.load(policy / "policy.safetensors")
        model = load_grounding(grounding / "grounding.safetensors") if grounding else None
        source = deploy(world, trained, model)
        encoders: dict[EncoderKind, DeployedPolicy] = {"source": source}
        if target_encoder is not None:
            aligned = load_target_encoder(target_encoder / "target_encoder.safetensors")
            encoders["target"] = replace(source, target_encoder=aligned)
        headline = config.encoder if config.encoder in encoders else "source"
        outcomes = {}
        for kind, deployed in encoders.items():
            outcomes[kind], rate = _in_target(world, deployed, config, seed, num_threads, progress)
        told |= {
            "encoder": headline,
            "target": outcomes[headline].to_json(),
            "encoders": {
                kind: {"success": sum(outcome.success) / config.episodes}
                for kind, outcome in outcomes.items()
            },
            "target_steps_per_second": rate,
            "dataset_version": trained.dataset,
            "dataset_hash": trained.content_hash,
        }
        tensors["target.position"] = outcomes[headline].position
        if trained.simulation is not None:
            simulated = _in_simulation(world, trained, trained.simulation, model, config, seed)
            told["simulated"] = simulated.to_json()
            tensors["simulated.position"] = simulated.position
    start_goal = _starts_and_goals(world, config, seed)
    with finished_folder(out) as folder:
        save_tensors(folder / "trajectories.safetensors", tensors | start_goal, {})
        told["wall_seconds"] = time.perf_counter() - began
        (folder / "evaluation.json").write_text(json.dumps(told, indent=1))
        (folder / "config.json").write_text(config.model_dump_json(indent=1))
    success = sum(told["target"]["success"]) / config.episodes
    progress(1.0, f"success in the target {success:.2f}")


def _in_target(
    task: Task,
    deployed: DeployedPolicy | None,
    config: EvaluateConfig,
    seed: int,
    num_threads: int | None,
    progress: Progress,
) -> tuple[Outcome, float]:
    """Return what happened in the target, and target steps/s."""
    env = task.target(
        config.episodes,
        seed=derive(seed, "evaluation"),
        leg_scale=config.leg_scale,
        num_threads=num_threads,
    )
    env.reset()
    act: Act
    if deployed is None:
        act = _follower(task, env.goal)
    else:
        deployed.start(config.episodes)
        act = deployed.act
    record = _Record(config.episodes, env.state[:, :2])
    began = time.perf_counter()
    for step in range(task.navigation.horizon):
        outcome = env.step(act(env.state, env.goal), record.active)
        record.add(env.state[:, :2], outcome.reward, outcome.success, env.toppled, env.wall_contact)
        rate = record.total_steps / (time.perf_counter() - began)
        progress((step + 1) / task.navigation.horizon * 0.99, f"{rate:,.0f} target steps/s")
        if not record.active.any():
            break
    return record.outcome(), rate


def _follower(task: Task, goal: Tensor) -> Act:
    follower = CarefulFollower(task.maze)
    fields = follower.fields(goal)
    return lambda state, goal: follower.command(state[:, :2], goal, fields)


def _starts_and_goals(task: Task, config: EvaluateConfig, seed: int) -> dict[str, Tensor]:
    env = task.target(config.episodes, seed=derive(seed, "evaluation"), num_threads=1)
    env.reset()
    return {"start": env.state[:, :2], "goal": env.goal}


@torch.no_grad()
def _in_simulation(
    task: Task,
    trained: PolicyFile,
    simulation: Simulation,
    grounding: Grounding | None,
    config: EvaluateConfig,
    seed: int,
) -> Outcome:
    """Run the policy in its training world, from the task's starts, with the world's own latents."""
    parts = WorldParts(simulation.thinness, simulation.scatter, variation=simulation.variation)
    world = training_world(task, simulation.world, parts, grounding, num_envs=config.episodes, device="cpu")
    policy = trained.policy
    torch.manual_seed(derive(seed, "simulated evaluation"))
    observation = world.reset()
    record = _Record(config.episodes, world.simulator.state[:, :2])
    previous, hidden = torch.zeros(config.episodes, 2), policy.initial_hidden(config.episodes)
    for _ in range(task.navigation.horizon):
        features, hidden = policy.remember(observation, previous, hidden)
        previous, _ = policy.policy(features)
        step = world.step(previous)
        observation = step.observation
        blocked = world.simulator.blocked
        record.add(world.simulator.state[:, :2], step.reward, step.success, world.toppled, blocked)
        if not record.active.any():
            break
    return record.outcome()


class _Record:
    """Follow N episodes until each has ended."""

    def __init__(self, count: int, position: Tensor) -> None:
        self.active = torch.ones(count, dtype=torch.bool)
        self.total_steps = 0
        self._success, self._topple, self._contact, self._steps, self._return = torch.zeros(5, count)
        self._positions = [position.clone()]

    def add(
        self, position: Tensor, reward: Tensor, success: Tensor, toppled: Tensor, contact: Tensor
    ) -> None:
        active = self.active
        self._success += success & active
        self._topple += toppled & active
        self._contact += contact & active
        self._steps += active
        self._return += reward * active
        self._positions.append(torch.where(active.unsqueeze(-1), position, torch.nan))
        self.total_steps += int(active.sum())
        self.active = active & ~success & ~toppled

    def outcome(self) -> Outcome:
        return Outcome(
            success=self._success.tolist(),
            topple=self._topple.tolist(),
            wall_contact=(self._contact / self._steps).tolist(),
            steps=self._steps.long().tolist(),
            returns=self._return.tolist(),
            position=torch.stack(self._positions, dim=1),
        )
