"""Evaluate: run a policy in the target environment and in simulators.

The simulators are the one that it was trained in, and two that are the same for all policies, to measure how
well each predicts the target: the raw simulator, and a grounded one as reference. These two give the task's
own reward. Of a task without a target, there are the simulators alone.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from torch import Tensor

from astra_data.core.checkpoint import finished_folder, save_tensors
from astra_data.core.config import AtOnce, Config, Positive
from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.manifest import write_manifest
from astra_data.core.progress import Progress, silent
from astra_data.core.provenance import origin
from astra_data.core.seeding import derive
from astra_data.core.stopwatch import Stopwatch
from astra_data.grounding.files import GROUNDING, TARGET_ENCODER, load_grounding, load_target_encoder
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.methods import method_named
from astra_data.methods.follower import careful
from astra_data.reports.artefacts import EVALUATION, TRAJECTORIES
from astra_data.training.deployment import EncoderKind
from astra_data.training.own_policy import OwnPolicy
from astra_data.training.own_world import Act, Begin, in_simulator, own_world, started
from astra_data.training.policy_file import POLICY, PolicyFile, deploy
from astra_data.training.recorded_range import RecordedRange
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.target_episodes import in_target
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task


class EvaluateConfig(Config):
    """How policies are tested; the paper uses 100 episodes."""

    episodes: AtOnce = 100
    """Run in one batch, in the target and in each simulator."""
    encoder: EncoderKind = "target"
    """Encoder with which an aligned policy is deployed for the headline figures; both are reported."""
    leg_scale: Positive = 1.0
    """Of the ant in the target environment; 1.25 is the paper's morphology test."""


def evaluate(
    task: str,
    method: str,
    config: EvaluateConfig = EvaluateConfig(),
    *,
    policy: Path | PolicyFile | None = None,
    grounding: Path | None = None,
    target_encoder: Path | None = None,
    reference: Path | None = None,
    recorded: Path | None = None,
    seed: int = 0,
    out: Path,
    progress: Progress = silent,
    num_threads: int | None = None,
) -> None:
    """Test a row and write its figures and paths to `out`.

    Starts, goals and headings depend on the seed alone, so they are the same for every method.

    Args:
        task: see `task_named`.
        method: a row.
        config: the recipe's `[evaluate]`.
        policy: what `train` made, for a row that trains; or a policy in its place.
        grounding: what `ground` made for it, for a row that grounds.
        target_encoder: what `align` made for it, for a row that aligns.
        reference: the grounding of the reference simulator, if there is one.
        recorded: the dataset whose range of commands those of the policy are compared with.
        seed: of all randomness.
        out: the folder to write.
        progress: called with the fraction done.
        num_threads: of the physics, by default one per core; the outcome is the same with any number.

    Raises:
        BadInputError: an input is missing or malformed.

    Example:
        >>> import json
        >>> from pathlib import Path
        >>> from astra_data import evaluate
        >>> from astra_data.stages.evaluate import EvaluateConfig
        >>> evaluate("antmaze-umaze", "follower", EvaluateConfig(episodes=2), out=Path("evaluation"))
        >>> json.loads(Path("evaluation/evaluation.json").read_text())["target"]["success"]
        [1.0, 1.0]
    """
    world, base = task_named(task), method_named(method)
    scores = world.objective.scores
    if base.trains and policy is None:
        raise BadInputError(f"method '{method}' needs its policy: run the stage `train` first")
    if not (base.trains or world.has_target):
        raise BadInputError(f"method '{method}' acts in a target, and {world.name} has none")
    if base.grounds and grounding is None:
        raise BadInputError(f"method '{method}' needs its grounding: run the stage `ground` first")
    stopwatch = Stopwatch()
    results: dict[str, Any] = {
        "task": world.name,
        "method": method,
        "seed": seed,
        "episodes": config.episodes,
    }
    results["leg_scale"] = config.leg_scale
    results |= origin()
    simulators: dict[str, SimulatorEnv] = {}
    headline: EncoderKind = "source"
    if policy is None:
        begin: Begin = partial(careful, world)
        robots: dict[EncoderKind, Begin] = {headline: partial(_careful_in_target, world)}
        shown_abstract = True
    else:
        trained = PolicyFile.load(policy / POLICY) if isinstance(policy, Path) else policy
        if isinstance(trained.policy, OwnPolicy):
            results["policy"] = trained.policy.name
        model: Grounding = NO_GROUNDING
        if grounding:
            model = load_grounding(grounding / GROUNDING)
        source = deploy(world, trained, model)
        begin = partial(started, source, source.act_in_simulator)
        robots = {"source": partial(started, source, source.act)}
        if target_encoder is not None:
            encoder = load_target_encoder(target_encoder / TARGET_ENCODER)
            aligned = replace(source, target_encoder=encoder)
            robots["target"] = partial(started, aligned, aligned.act)
        headline = config.encoder if config.encoder in robots else "source"
        results |= {
            "encoder": headline,
            "dataset_version": trained.dataset,
            "dataset_hash": trained.content_hash,
        }
        shown_abstract = trained.observed == "abstract"
        if trained.simulation is not None:
            simulators["simulated"] = own_world(world, trained.simulation, model, config.episodes)
    if shown_abstract:
        simulators |= _shared_simulators(world, reference, config)
    files = {
        "policy": policy / POLICY if isinstance(policy, Path) else None,
        "grounding": grounding and grounding / GROUNDING,
        "target_encoder": target_encoder and target_encoder / TARGET_ENCODER,
        "reference": reference and reference / GROUNDING,
    }
    read = {name: file_digest(file) for name, file in files.items() if file}
    tensors: dict[str, Tensor] = {}
    asked = None if recorded is None else RecordedRange.of(recorded, world.limits)
    tested_in = "target" if world.has_target else "grounded" if "grounded" in simulators else "raw"
    if world.has_target:
        outcomes, filmed = {}, {}
        for kind, robot in robots.items():
            counted = asked if kind == headline else None
            outcomes[kind], filmed[kind], rate, start_goal = in_target(
                world,
                robot,
                config.episodes,
                derive(seed, "evaluation"),
                leg_scale=config.leg_scale,
                num_threads=num_threads,
                progress=progress,
                asked=counted,
            )
        if policy is not None:
            results["encoders"] = {
                kind: {score.measure: fmean(outcome.to_json()[score.measure]) for score in scores}
                for kind, outcome in outcomes.items()
            }
        results |= {"target": outcomes[headline].to_json(), "target_steps_per_second": rate}
        tensors["target.position"] = outcomes[headline].position
        if world.photograph is not None:
            tensors["target.state"] = filmed[headline]
    else:
        results |= {"tested_in": tested_in, "encoder": "source"}
    for name, simulated in simulators.items():
        counted = asked if name == tested_in else None
        outcome, simulated_starts = in_simulator(
            simulated, begin, world.objective.horizon, derive(seed, "simulated evaluation"), counted
        )
        if name == tested_in:
            start_goal = simulated_starts
        results[name] = outcome.to_json()
        if name in ("simulated", tested_in):
            tensors[f"{name}.position"] = outcome.position
    if asked is not None:
        results["beyond_recorded"] = asked.share
    with finished_folder(out) as folder:
        save_tensors(folder / TRAJECTORIES, tensors | start_goal, {})
        results |= stopwatch.spent()
        (folder / EVALUATION).write_text(json.dumps(results, indent=1))
        (folder / "config.json").write_text(config.model_dump_json(indent=1))
        write_manifest(folder, read)
    first = scores[0]
    where = "target" if world.has_target else f"{tested_in} simulator"
    progress(1.0, f"{first.title} in the {where} {first.text(fmean(results[tested_in][first.measure]))}")


def _careful_in_target(task: Task, goal: Tensor) -> Act:
    act = careful(task, goal)
    return lambda state, goal: act(task.abstraction(state), goal)


def _shared_simulators(task: Task, reference: Path | None, config: EvaluateConfig) -> dict[str, SimulatorEnv]:
    groundings: dict[str, Grounding] = {"raw": NO_GROUNDING}
    if reference is not None:
        groundings["grounded"] = load_grounding(reference / GROUNDING)
    return {
        name: SimulatorEnv(task.objective, grounding.simulator(task, config.episodes))
        for name, grounding in groundings.items()
    }
