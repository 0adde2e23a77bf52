"""The environment in which a row is trained, also "astra_data/Grounded-v0", for others' learners; their test."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from astra_data.core.config import did_you_mean, validated
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key, is_plus
from astra_data.core.progress import Progress, silent
from astra_data.grounding.files import GROUNDING, grounding_at
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import method_named
from astra_data.pipeline.plan import ARTIFACTS, plan, selected
from astra_data.pipeline.recipe import Recipe, add_all
from astra_data.pipeline.trained_policy import check_seed, settings_of
from astra_data.policies.learner import ActingPolicy
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.simulator_env import Simulation, SimulatorEnv
from astra_data.policies.train import InSimulator, Training
from astra_data.robots.registry import task_named

if TYPE_CHECKING:
    from astra_data.policies.gymnasium import BatchedVectorEnv, SingleEnv

OPTIONS = ("data_start_share", "episode_steps")  # the keywords of an environment, keys of `[train]`


def grounded(run: str | Path, row: str, seed: int = 0, percent: int | None = None, **options: Any) -> "SingleEnv":
    """Build the environment of one robot in which a row of a run is trained, of `seed`, with `options` of `OPTIONS`."""
    from astra_data.policies.gymnasium import SeededSimulatorEnv, SingleEnv

    env, _, training = _world(run, settings_of(run), row, seed, percent, num_envs=1, **options)
    return SingleEnv(SeededSimulatorEnv(env), training.simulated_steps)


def grounded_vector(
    num_envs: int,
    run: str | Path,
    row: str,
    seed: int = 0,
    percent: int | None = None,
    max_episode_steps: int | None = None,
    **options: Any,
) -> "BatchedVectorEnv":
    """Build `num_envs` of the environments that `grounded` builds, stepped at once."""
    from astra_data.policies.gymnasium import BatchedVectorEnv, SeededSimulatorEnv

    env, _, training = _world(run, settings_of(run), row, seed, percent, num_envs=num_envs, **options)
    steps = training.simulated_steps
    return BatchedVectorEnv(SeededSimulatorEnv(env), min(steps, max_episode_steps or steps))


def evaluate_policy(
    run: str | Path,
    row: str,
    policy: ActingPolicy,
    *,
    out: str | Path,
    seed: int = 0,
    percent: int | None = None,
    progress: Progress = silent,
) -> None:
    """Test a policy of another learner as `evaluate` tests that of a row, and write the figures to `out`.

    It is shown what the row's environment shows; a latent comes from the row's encoder, aligned in the target.
    """
    settings = settings_of(run)
    env, simulation, training = _world(run, settings, row, seed, percent, num_envs=1)
    from astra_data.policies.networks import UserPolicy

    own = UserPolicy(policy, env.observation_size, env.action_size)
    rows = list(dict.fromkeys([*settings.get("methods", []), row]))
    tested = {"seeds": [seed]} | settings | {"methods": rows}
    evaluate = _planned(run, tested, "evaluate", row, seed, percent)
    file = PolicyFile(own, simulation, training.episodes.reference, training.episodes.content_hash)
    evaluate(policy=file, out=Path(out), progress=progress)


def _world(
    run: str | Path, settings: dict[str, Any], row: str, seed: int, percent: int | None, **options: Any
) -> tuple[SimulatorEnv, Simulation, Training]:
    """Return the environment that `train` builds for a row, and what it builds it from."""
    add_all(settings.get("user_methods", {}))
    learn = method_named(row).learn
    if not isinstance(learn, InSimulator):
        expected = "expected a row that is, such as nas, or direct_transfer for the raw simulator"
        raise BadInputError(f"{row} is not trained in a simulator: {expected}")
    if unknown := sorted(options.keys() - {*OPTIONS, "num_envs"}):
        raise BadInputError(f"Grounded-v0: unknown option '{unknown[0]}'{did_you_mean(unknown[0], OPTIONS)}")
    changed = {"methods": [row], "seeds": [seed], "train": settings.get("train", {}) | options}
    train = _planned(run, settings | changed, "train", row, seed, percent).keywords
    training = Training(
        task=task_named(train["task"]),
        config=train["config"],
        settings=train["settings"],
        episodes=PairedEpisodes.load(train["dataset"]),
        grounding=grounding_at(train["grounding"] and train["grounding"] / GROUNDING),
        initial=None,
        seed=seed,
        device="cpu",
        folder=Path(run),
        progress=silent,
        is_plus=is_plus(row),
    )
    return *learn.world(training), training


def _planned(
    run: str | Path, settings: dict[str, Any], stage: str, row: str, seed: int, percent: int | None
) -> partial[object]:
    """Return the call by which a run with these `settings` makes the artifact of a row of others."""
    recipe = validated(settings | {"select": None}, Recipe, f"{run}")
    only = selected(recipe, (row,), (seed,), () if percent is None else (percent,))
    items = {item.key: item.call for item in plan(recipe, Path(f"{run}.toml"), Path(run), only)}
    call = items.get(artifact_key(stage, row, seed, percent))
    if not isinstance(call, partial):
        raise BadInputError(f"{run} has several sizes: expected percent, one of {[*recipe.sweep.percent]}")
    places = [place for name in ARTIFACTS if name != "policy" and (place := call.keywords.get(name))]
    if missing := [str(place) for place in places if not place.is_dir()]:
        check_seed(settings_of(run), seed)
        raise BadInputError(f"expected {', '.join(missing)}: run the recipe first")
    return call
