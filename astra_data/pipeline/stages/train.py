"""Train: learn the policy of a row with its method."""

import json
from functools import partial
from pathlib import Path
from typing import Any

from astra_data.core.artifact import finished_folder
from astra_data.core.config import Config, as_json
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.naming import is_plus
from astra_data.core.progress import Progress, Stopwatch, silent
from astra_data.core.provenance import origin
from astra_data.grounding.files import GROUNDING, grounding_at
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import method_named
from astra_data.policies.running_policy import POLICY, PolicyFile
from astra_data.policies.train import Learn, PpoTrainConfig, SacTrainConfig, Training, with_restarts
from astra_data.reports.artifacts import CURVE
from astra_data.robots.registry import task_named
from astra_data.worlds.objective import NO_LIMIT


def train(
    task: str,
    method: str,
    config: PpoTrainConfig | SacTrainConfig = PpoTrainConfig(),
    *,
    settings: Config | None = None,
    dataset: str | Path,
    grounding: Path | None = None,
    initial: Path | None = None,
    seed: int = 0,
    out: Path,
    device: str = "cpu",
    progress: Progress = silent,
    num_threads: int | None = None,
) -> None:
    """Learn the policy of the row `method` on a paired `dataset`; write it with its learning curve to `out`.

    It needs the folder that `ground` made for the method, if that grounds, and as `initial` the one that `train`
    made for the method whose policy it starts from, if any. `settings` are the method's own.

    Raises:
        BadInputError: the method has no policy to train, needs an artifact and got none, or `out` was begun
            with other settings.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import train
        >>> from astra_data.policies.train import PpoTrainConfig
        >>> config = PpoTrainConfig(num_envs=8, rollout_steps=8, total_steps=64)
        >>> train("antmaze-umaze", "direct_transfer", config, dataset="pairs", out=Path("policy"))
    """
    base, world, made = method_named(method), task_named(task), origin(device)
    if base.learn is None:
        raise BadInputError(f"method '{method}' has no policy to train")
    if base.grounds and grounding is None:
        raise BadInputError(f"method '{method}' trains in a grounded simulator: run the stage `ground` first")
    if base.initial and initial is None:
        raise BadInputError(f"method '{method}' starts from the policy of {base.initial}: train that first")
    stopwatch = Stopwatch()
    episodes = PairedEpisodes.load(dataset, device)
    sees_data = base.grounds or base.learns_from == "episodes" or config.data_start_share > 0
    episodes.check(world, needs_goals=sees_data)
    grounding_file = grounding and grounding / GROUNDING
    initial_file = initial and initial / POLICY
    correction = grounding_at(grounding_file, device)
    if check := getattr(correction.encoder, "check", None):
        check(episodes)
    beginning = PolicyFile.load(initial_file, device) if initial_file else None
    if beginning and beginning.simulation and beginning.simulation.world.command_limit != NO_LIMIT:
        fault = "was trained with command_limit, which has no effect on"
        raise BadInputError(f"{initial} {fault} '{method}': train it without")
    grounding_digest = file_digest(grounding_file) if grounding_file else None
    initial_digest = file_digest(initial_file) if initial_file else None
    named = {"task": world.name, "method": method, **episodes.named}
    sums = {"grounding_sha256": grounding_digest, "initial_sha256": initial_digest}
    settings_text = as_json(**named, **sums, seed=seed, train=config, settings=settings)
    read = {"dataset": episodes.content_hash, "grounding": grounding_digest, "initial": initial_digest}
    with finished_folder(out, config=settings_text, made_from=read) as folder:
        training = Training(
            task=world,
            config=config,
            settings=settings,
            episodes=episodes,
            grounding=correction,
            initial=beginning,
            seed=seed,
            device=device,
            folder=folder,
            progress=progress,
            num_threads=num_threads,
            is_plus=is_plus(method),
        )
        learn = partial(_learned, base.learn)
        if base.in_simulator:
            policy, curve = with_restarts(learn, training, grounding_file)
        else:
            policy, curve = learn(training)
        policy.save(folder / POLICY)
        if policy.simulation is not None:
            curve["world"] = policy.simulation.world.model_dump()
        spent = stopwatch.spent()
        figures = made | spent | curve | {"finished_at": spent["finished_at"]}  # of the last part, whichever is kept
        (folder / CURVE).write_text(json.dumps(figures, indent=1))


def _learned(learn: Learn, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
    """Return the policy and the learning curve that `learn`, perhaps a function of the user's, returns."""
    match returned := learn(training):
        case (PolicyFile() as policy, dict() as curve):
            return policy, curve
    parts = returned if isinstance(returned, tuple) else (returned,)
    raise BadInputError(
        f"learn returned {' and '.join(type(part).__name__ for part in parts) or 'nothing'}: expected a PolicyFile and "
        "a dict of the learning curve; one that returns a policy of another learner is given to an UserLearner"
    )
