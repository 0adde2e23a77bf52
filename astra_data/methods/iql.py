"""IQL on the target's own episodes, direct transfer fine-tuned by it (Section V), and behavior cloning.

The paper does not say whether the fine-tuning interacts with the target: ours learns from the same episodes.
"""

import copy
from dataclasses import replace
from typing import Any

import torch

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.checkpoint import Logbook
from astra_data.core.config import own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.dataset.columns import REWARD
from astra_data.grounding.encoder import PositionFeatures
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods.method import Method, Table
from astra_data.policies.iql import Experience, Iql, IqlConfig
from astra_data.policies.networks import ActorCritic, ActorCriticShape, Policy
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.simulator_env import policy_observation
from astra_data.policies.train import Training
from astra_data.worlds.task import Task

_CHECKPOINT_EVERY = 500
_POSITION_OCTAVES = 4


def _position_features(task: Task) -> PositionFeatures:
    return PositionFeatures(_POSITION_OCTAVES if task.plane else 0)


def learn_from_episodes(training: Training) -> tuple[PolicyFile, dict[str, Any]]:
    """Learn by IQL from the target's side of the paired episodes; return the policy, and losses every few updates."""
    config, episodes = _config(training), training.episodes
    if config.temperature and not episodes.has_rewards:
        raise BadInputError(f"{episodes.reference} has no {REWARD}, from which the policy would be learned")
    experience = experience_of(training.task, episodes)
    torch.manual_seed(derive(training.seed, "policy"))
    if training.initial is None:
        shape = ActorCriticShape(
            observation_size=experience.observation.shape[-1] - _position_features(training.task).size,
            action_size=experience.action.shape[-1],
            memory_size=training.config.memory_size,
            hidden_sizes=training.config.hidden_sizes,
        )
        policy: Policy = ActorCritic(shape).to(training.device)
    else:
        policy = copy.deepcopy(training.initial.policy).requires_grad_(True)
    curve = _optimize(Iql(policy, experience, config, seed=training.seed), training)
    return training.learned(policy, None), curve


def clone_behavior(training: Training) -> tuple[PolicyFile, dict[str, Any]]:
    """Imitate all recorded actions equally, as IQL does at temperature 0; see `learn_from_episodes`."""
    cloning = _config(training).model_copy(update={"temperature": 0.0, "critic_updates": 1, "return_steps": 1})
    return learn_from_episodes(replace(training, settings=cloning))


def _config(training: Training) -> IqlConfig:
    """Return the settings; a trained policy is tuned by fewer and smaller updates."""
    config = own_settings(training.settings, IqlConfig())
    if training.initial is None:
        return config
    fewer = {"policy_updates": config.fine_tuning_updates, "learning_rate": config.learning_rate / 10}
    return config.model_copy(update=fewer)


def experience_of(task: Task, episodes: PairedEpisodes) -> Experience:
    """Return the target's side of `episodes` as a policy sees it, and sines and cosines of the position for critics."""
    windows = episodes.windows
    features = _position_features(task).to(windows.state.device)
    now, later = (
        torch.cat([policy_observation(task.objective, state, windows.goal, None), features(state[..., :2])], dim=-1)
        for state in (windows.state, windows.next_state)
    )
    return Experience(
        observation=now,
        previous_action=windows.previous_action,
        action=windows.action,
        reward=episodes.reward,
        next_observation=later,
        terminated=episodes.terminated,
        lengths=episodes.lengths,
    )


def _optimize(iql: Iql, training: Training) -> dict[str, Any]:
    """Train to the end, resuming from the checkpoint in the folder if there is one; return the losses."""
    logbook = Logbook(training.folder / CHECKPOINT, iql.load_state_dict)
    points, stopwatch = logbook.points, logbook.stopwatch
    while not iql.done:
        losses = iql.iterate()
        if iql.updates % 10 == 0 or iql.done:
            shown = "  ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in losses.items())
            note = f"{iql.updates / stopwatch.seconds:,.0f} updates/s  {shown}"
            training.progress(iql.updates / iql.total_updates, note)
        if iql.updates % _CHECKPOINT_EVERY == 0 or iql.done:
            # No policy acts while learning from recorded episodes, so there is no success rate.
            points.append({"steps": iql.updates, "success": None, **losses})
            logbook.keep(iql.state_dict())
    return {"updates_per_second": iql.updates / stopwatch.seconds, **stopwatch.spent(), "points": points}


IQL = Method(
    name="iql",
    title="IQL",
    color="#D55E00",
    learn=learn_from_episodes,
    learns_from="episodes",
    table=Table("iql", IqlConfig),
)
BEHAVIOR_CLONING = replace(
    IQL, name="behavior_cloning", title="Behavior cloning", color="#AA4499", learn=clone_behavior
)
DIRECT_TRANSFER_IQL = replace(
    IQL, name="direct_transfer_iql", title="Direct transfer + IQL", color="#7B3294", initial="direct_transfer"
)
"""Fits the critics while the policy is left as it is; then fine-tunes direct transfer's policy, gently."""
