"""Evaluate: run a policy in the target, if there is one, where it was trained, and in two simulators for all."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from astra_data.core.artifact import check_made_from, finished_folder, refuse_finished
from astra_data.core.checkpoint import save_tensors
from astra_data.core.config import AtOnce, Config, Positive
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor
from astra_data.core.progress import Progress, Stopwatch, silent
from astra_data.core.provenance import origin
from astra_data.core.seeding import derive
from astra_data.grounding.files import GROUNDING, TARGET_ENCODER, grounding_at, load_grounding, load_target_encoder
from astra_data.grounding.simulator import NO_GROUNDING, Grounding
from astra_data.methods import method_named
from astra_data.methods.follower import careful
from astra_data.policies.episodes import Act, Begin, RecordedRange, in_simulator, in_target, started
from astra_data.policies.running_policy import POLICY, EncoderKind, PolicyFile, running
from astra_data.policies.simulator_env import SimulatorEnv, training_env
from astra_data.reports.artifacts import EVALUATION, TRAJECTORIES
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task


class EvaluateConfig(Config):
    """How policies are tested; the paper uses 100 episodes."""

    episodes: AtOnce = 100
    """Episodes in the target and in each simulator, run in one batch."""
    encoder: EncoderKind | None = None
    """Encoder that an aligned policy runs with; by default ψ^t, or ψ^s where ψ^t is coarse on held-out
    episodes. Results with both are reported."""
    leg_scale: Positive = 1.0
    """Scale of the ant's legs in the target environment; 1.25 is the paper's morphology test."""


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

    Starts, goals and headings depend on the seed alone, so they are the same for every method, and with any
    `num_threads` of the physics. `policy` is what `train` made, or a policy in its place, `grounding` what `ground`
    made and `target_encoder` what `align` made, for a row that trains, grounds, aligns; `reference` is the grounding of
    the reference simulator, if there is one, and `recorded` the dataset with whose commands the policy's are compared.

    Raises:
        BadInputError: an input is missing, malformed or of another grounding, or `out` exists.

    Example:
        >>> import json
        >>> from pathlib import Path
        >>> from astra_data import evaluate
        >>> from astra_data.pipeline.stages.evaluate import EvaluateConfig
        >>> evaluate("antmaze-umaze", "follower", EvaluateConfig(episodes=2), out=Path("evaluation"))
        >>> json.loads(Path("evaluation/evaluation.json").read_text())["target"]["success"]
        [1.0, 1.0]
    """
    refuse_finished(out)
    world = task_named(task)
    base = method_named(method)
    if base.trains and policy is None:
        raise BadInputError(f"method '{method}' needs its policy: run the stage `train` first")
    if not base.trains and policy is not None:
        raise BadInputError(f"method '{method}' has no policy: leave it out, or name the policy's row")
    if not (base.trains or world.has_target):
        raise BadInputError(f"method '{method}' acts in a target, and {world.name} has none")
    if base.grounds and grounding is None:
        raise BadInputError(f"method '{method}' needs its grounding: run the stage `ground` first")
    stopwatch = Stopwatch()
    files = {
        "policy": policy / POLICY if isinstance(policy, Path) else None,
        "grounding": grounding and grounding / GROUNDING,
        "target_encoder": target_encoder and target_encoder / TARGET_ENCODER,
        "reference": reference and reference / GROUNDING,
    }
    read = {name: file for name, file in files.items() if file}
    if missing := [f"{file}" for file in read.values() if not file.is_file()]:
        raise BadInputError(f"{missing[0]} does not exist: run the stage that makes it first")
    made_from = {name: file_digest(file) for name, file in read.items()}
    for name in made_from.keys() & {"policy", "target_encoder"}:
        check_made_from(read[name], {"grounding": made_from.get("grounding")})
    if policy is None:
        row = _Row(partial(careful, world), {"source": partial(_careful_in_target, world)}, "source")
    else:
        row = _policy(world, policy if isinstance(policy, PolicyFile) else None, read, config)
    if not (world.has_target or row.shown_abstract):
        raise BadInputError(f"the policy of '{method}' observes the full state of a target, and {world.name} has none")
    simulators = dict(row.simulators)
    if row.shown_abstract:
        groundings: dict[str, Grounding] = {"raw": NO_GROUNDING}
        if "reference" in read:
            groundings["grounded"] = load_grounding(read["reference"])
        for name, made in groundings.items():
            simulators[name] = SimulatorEnv(world.objective, made.simulator(world, config.episodes))
    asked = None if recorded is None else RecordedRange.of(recorded, world.limits)
    tested_in = "target" if world.has_target else "grounded" if "grounded" in simulators else "raw"
    about = {"task": world.name, "method": method, "seed": seed, "episodes": config.episodes}
    results: dict[str, Any] = {**about, "leg_scale": config.leg_scale, **origin(), **row.facts}
    tensors: dict[str, Tensor] = {}
    if world.has_target:
        drawn = derive(seed, "evaluation")
        options: dict[str, Any] = {"leg_scale": config.leg_scale, "num_threads": num_threads, "progress": progress}
        tested = {
            kind: in_target(
                world, robot, config.episodes, drawn, **options, asked=asked if kind == row.headline else None
            )
            for kind, robot in row.robots.items()
        }
        if len(tested) > 1:
            outcomes = {kind: outcome.to_json() for kind, outcome in tested.items()}
            measures = [score.measure for score in world.objective.scores]
            results["encoders"] = {kind: {one: fmean(of[one]) for one in measures} for kind, of in outcomes.items()}
        headline = tested[row.headline]
        results["target"] = headline.to_json()
        tensors = {"target.position": headline.position} | headline.start_goal
    else:
        results |= {"tested_in": tested_in, "encoder": "source"}
    for name, simulator in simulators.items():
        drawn, counted = derive(seed, "simulated evaluation"), asked if name == tested_in else None
        outcome = in_simulator(simulator, row.begin, world.objective.horizon, drawn, counted)
        results[name] = outcome.to_json()
        tensors |= outcome.start_goal if name == tested_in else {}
        tensors |= {f"{name}.position": outcome.position} if name in ("simulated", tested_in) else {}
    if asked is not None:
        results["beyond_recorded"] = asked.share
    with finished_folder(out, made_from=made_from) as folder:
        save_tensors(folder / TRAJECTORIES, tensors, {})
        results |= stopwatch.spent()
        (folder / EVALUATION).write_text(json.dumps(results, indent=1))
        (folder / "config.json").write_text(config.model_dump_json(indent=1))
    first = world.objective.scores[0]
    where = "target" if world.has_target else f"{tested_in} simulator"
    progress(1.0, f"{first.title} in the {where} {first.text(fmean(results[tested_in][first.measure]))}")


@dataclass(frozen=True)
class _Row:
    """What is tested: in simulators by `begin`, in the target by `robots` of the encoder, `headline` for figures."""

    begin: Begin
    robots: dict[EncoderKind, Begin]
    headline: EncoderKind
    simulators: dict[str, SimulatorEnv] = field(default_factory=dict)
    shown_abstract: bool = True
    facts: dict[str, Any] = field(default_factory=dict)  # of its policy, if it is one


def _policy(task: Task, loaded: PolicyFile | None, files: Mapping[str, Path], config: EvaluateConfig) -> _Row:
    from astra_data.policies.networks import UserPolicy

    trained = loaded or PolicyFile.load(files["policy"])
    grounding = grounding_at(files.get("grounding"))
    source = running(task, trained, grounding)
    robots: dict[EncoderKind, Begin] = {"source": partial(started, source, source.act)}
    headline: EncoderKind = "source"
    if "target_encoder" in files:
        encoder = load_target_encoder(files["target_encoder"])
        # A target shows states alone: what reads other inputs is tested on the robot.
        if not encoder.inputs or (config.encoder == "target" and task.has_target):
            aligned = replace(source, target_encoder=encoder)
            robots["target"] = partial(started, aligned, aligned.act)
            headline = config.encoder or ("target" if encoder.is_deployed else "source")
    facts: dict[str, Any] = {"policy": trained.policy.name} if isinstance(trained.policy, UserPolicy) else {}
    facts |= {"encoder": headline, "dataset_version": trained.dataset, "dataset_hash": trained.content_hash}
    simulators = {}
    if trained.simulation is not None:
        simulators["simulated"] = training_env(task, trained.simulation, grounding, num_envs=config.episodes)
    begin, is_abstract = partial(started, source, source.act_in_simulator), trained.observed == "abstract"
    return _Row(begin, robots, headline, simulators, is_abstract, facts)


def _careful_in_target(task: Task, goal: Tensor) -> Act:
    act = careful(task, goal)
    return lambda state, goal: act(task.abstraction(state), goal)
