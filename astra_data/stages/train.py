"""Train: optimise a policy by PPO in the raw or grounded simulator (Algorithm 2)."""

import json
import math
import time
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from astra_data.checkpoint import finished_folder, flatten, load_tensors, save_tensors, unflatten
from astra_data.dataset.pairs import PairedEpisodes
from astra_data.errors import BadInputError
from astra_data.grounding_file import load_grounding
from astra_data.learners.ppo import Ppo, PpoConfig
from astra_data.methods import method_named
from astra_data.models.actor_critic import ActorCritic, ActorCriticShape
from astra_data.policy_file import PolicyFile
from astra_data.progress import Progress
from astra_data.recipe import Count
from astra_data.results.provenance import origin
from astra_data.seeding import derive
from astra_data.tasks import task_named
from astra_data.training_world import WorldConfig, training_world, world_parts
from astra_data.world import NavigationWorld

_CHECKPOINT_EVERY = 20


class TrainConfig(WorldConfig, PpoConfig):
    """How policies are trained: PPO's settings, the world's switches, and the sizes below."""

    num_envs: Count = 256
    """Worlds stepped side by side."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Of actor and critic."""
    memory_size: int = 64
    """Of the policy's own GRU, where no grounding provides a latent."""


def train(
    task: str,
    method: str,
    config: TrainConfig,
    *,
    dataset: Path,
    grounding: Path | None,
    seed: int,
    out: Path,
    device: str,
    progress: Progress,
) -> None:
    """Train the policy of a row and write it with its learning curve to `out`.

    Raises:
        BadInputError: the method has no policy to train, or needs a grounding and got none.
    """
    base, world, made = method_named(method), task_named(task), origin(device)
    if not base.trains:
        raise BadInputError(f"method '{method}' has no policy to train")
    if base.grounds and grounding is None:
        raise BadInputError(f"method '{method}' trains in a grounded simulator: run the stage `ground` first")
    weights = base.loss_weights
    if (config.reward or base.reward) == "predicted" and weights is not None and weights.reward == 0:
        raise BadInputError(f"'{method}' learns no reward: expected reward abstract or blend, got predicted")
    model = load_grounding(grounding / "grounding.safetensors", device) if grounding else None
    episodes = PairedEpisodes.load(dataset, device)
    parts = world_parts(world, config, episodes, model)
    env = training_world(world, base, config, parts, model, num_envs=config.num_envs, device=device)
    torch.manual_seed(derive(seed, "policy"))
    policy = ActorCritic(
        ActorCriticShape(
            observation_size=env.observation_size,
            action_size=env.action_size,
            memory_size=0 if model is not None else config.memory_size,
            hidden_sizes=config.hidden_sizes,
        )
    ).to(device)
    ppo = Ppo(env, policy, config, horizon=world.navigation.horizon, seed=seed)
    with finished_folder(out) as folder:
        curve = _optimise(ppo, env, config.ramp, folder, device, progress)
        switches = WorldConfig(**{name: getattr(config, name) for name in WorldConfig.model_fields})
        PolicyFile(
            policy, parts.thinness, parts.scatter, switches, episodes.reference, episodes.content_hash
        ).save(folder / "policy.safetensors")
        (folder / "curve.json").write_text(json.dumps(made | curve, indent=1))
        (folder / "config.json").write_text(config.model_dump_json(indent=1))
        (folder / "checkpoint.safetensors").unlink(missing_ok=True)


def _optimise(
    ppo: Ppo, env: NavigationWorld, ramp: float, folder: Path, device: str, progress: Progress
) -> dict[str, Any]:
    points: list[dict[str, float | None]] = []
    seconds = 0.0
    checkpoint = folder / "checkpoint.safetensors"
    if checkpoint.exists():
        tensors, told = load_tensors(checkpoint)
        state = unflatten(tensors)
        world = {name: values.to(device) for name, values in state["world"].items()}
        ppo.load_state_dict(state["ppo"], env.load_state_dict(world))
        points, seconds = told["points"], told["seconds"]
    began, first = time.perf_counter() - seconds, ppo.steps
    while not ppo.done:
        env.caution = min(1.0, ppo.steps / (ppo.config.total_steps * ramp)) if ramp else 1.0
        metrics = ppo.iterate()
        # JSON knows no NaN: what is undefined, such as the success of no episodes, is null.
        known = {name: None if math.isnan(value) else value for name, value in metrics.items()}
        points.append({"steps": ppo.steps, **known})
        seconds = time.perf_counter() - began
        rate = ppo.steps / seconds
        recent = [point["success"] for point in points[-10:] if point["success"] is not None]
        success = f"{fmean(recent):.2f}" if recent else "unknown yet"
        note = f"{rate:,.0f} steps/s  success of training episodes {success}"
        progress(ppo.steps / ppo.config.total_steps, note)
        if len(points) % _CHECKPOINT_EVERY == 0:
            state = {"ppo": ppo.state_dict(), "world": env.state_dict()}
            save_tensors(checkpoint, flatten(state), {"points": points, "seconds": seconds})
    return {
        "steps_per_second": ppo.steps / max(seconds, 1e-9),
        "simulator_steps_per_second": (ppo.steps - first) / max(ppo.world_seconds, 1e-9),
        "wall_seconds": seconds,
        "points": points,
    }
