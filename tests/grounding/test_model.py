"""On a world whose error in simulation depends on the actions of the past, which no single state shows."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from astra_data.grounding.encoder import take_scales
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights
from astra_data.grounding.paired_episodes import PairedWindows

LATENT_ALONE = LossWeights(latent=1.0, reward=0.0, state=0.0)
SIZE = 16


def lagging_world(episodes: int, steps: int, seed: int) -> PairedWindows:
    """Return episodes in which the target is dragged along by a low-pass of past actions."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.rand(episodes, steps, 2, generator=generator) * 2 - 1
    state, simulated = torch.zeros(episodes, steps + 1, 2), torch.zeros(episodes, steps, 2)
    drag = torch.zeros(episodes, 2)
    for step in range(steps):
        simulated[:, step] = state[:, step] + 0.1 * action[:, step]
        state[:, step + 1] = simulated[:, step] + 0.2 * drag
        drag = 0.7 * drag + 0.3 * action[:, step]
    return PairedWindows(
        state=state[:, :-1],
        action=action,
        previous_action=torch.cat([torch.zeros(episodes, 1, 2), action[:, :-1]], dim=1),
        goal=torch.zeros(episodes, steps, 2),
        simulated_next=simulated,
        next_state=state[:, 1:],
        reward=state[:, 1:].norm(dim=-1),
        goes_on=torch.ones(episodes, steps),
        failed=torch.zeros(episodes, steps),
        fails_soon=torch.zeros(episodes, steps),
        mask=torch.ones(episodes, steps),
    )


TRAINING, HELD_OUT = lagging_world(32, 30, seed=0), lagging_world(64, 30, seed=1)


def untrained() -> GroundingModel:
    torch.manual_seed(0)
    shape = GroundingShape(
        2, 2, 2, latent_size=SIZE, embedding_size=32, head_sizes=(32,), position_octaves=0, corrects_reward=False
    )
    model = GroundingModel(shape)
    take_scales(
        model,
        {
            "state": TRAINING.state.flatten(0, 1),
            "goal": TRAINING.goal.flatten(0, 1),
            "correction": (TRAINING.next_state - TRAINING.simulated_next).flatten(0, 1),
        },
    )
    model.set_reward_scales(TRAINING.reward.reshape(-1, 1), TRAINING.goes_on.flatten(), TRAINING.failed.flatten())
    return model


def fit(model: GroundingModel, weights: LossWeights, updates: int = 130) -> float:
    """Train `model` and return the last loss of the latent, if it has one."""
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=3e-3)
    parts: dict[str, Tensor] = {}
    for _ in range(updates):
        loss, parts = model.losses(TRAINING, weights)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        model.update_target()
    return float(parts.get("latent", torch.zeros(())).detach())


@torch.no_grad()
def latents(model: GroundingModel) -> Tensor:
    latent, _ = model.encoder(model.encoder_input(HELD_OUT.state, HELD_OUT.goal, HELD_OUT.previous_action))
    return torch.as_tensor(latent)


def spread(model: GroundingModel) -> float:
    """Return the standard deviation of the latents' entries over held-out histories."""
    return float(latents(model).flatten(0, 1).std(0).mean())


def test_the_latents_loss_does_not_collapse_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LayerNorm fixes the length of each latent, but not that different histories differ in theirs.

    With an encoder that follows at once, all histories come to share one latent, and the loss falls to what
    the bounds of the predicted variance allow, having learned nothing.
    """
    lowest = 0.5 * GroundingShape(2, 2, 2).log_variance_bounds[0]
    slow, online = untrained(), untrained()
    monkeypatch.setattr(online, "_following_latent", lambda inputs: online.encoder.sequence(inputs)[0][:, 1:])
    assert fit(online, LATENT_ALONE) == pytest.approx(lowest, abs=0.1)
    assert fit(slow, LATENT_ALONE) > lowest + 0.2
    assert spread(online) < 0.05 < 0.4 < spread(slow)


def test_masked_steps_do_not_count() -> None:
    model = untrained()
    torch.nn.init.normal_(list(model.correction.parameters())[-1])
    mask = TRAINING.mask.clone()
    mask[:, 20:] = 0.0
    cut = PairedWindows(**{name: values[:, :20] for name, values in vars(TRAINING).items() if values is not None})
    spoiled = replace(TRAINING, mask=mask, reward=TRAINING.reward + 1e3 * (1 - mask))
    _, parts = model.losses(spoiled, LossWeights())
    _, expected = model.losses(cut, LossWeights())
    assert parts.keys() == expected.keys() == {"latent", "reward", "state"}
    for name, value in expected.items():
        torch.testing.assert_close(parts[name], value, msg=name)


def test_scales_are_those_of_the_values_and_plain_without_any() -> None:
    network, values = nn.Module(), torch.tensor([[1.0, 5.0], [3.0, 5.0]])
    for name, size in {"state": 2, "goal": 0, "unseen": 1}.items():
        network.register_buffer(f"{name}_mean", torch.zeros(size))
        network.register_buffer(f"{name}_std", torch.ones(size))
    take_scales(network, {"state": values, "goal": torch.zeros(2, 0)})
    found = {name: buffer.tolist() for name, buffer in network.state_dict().items()}
    assert found == {
        "state_mean": [2.0, 5.0],
        "state_std": [torch.tensor(2.0).sqrt().item(), torch.tensor(1e-3).item()],
        "goal_mean": [],
        "goal_std": [],
        "unseen_mean": [0.0],
        "unseen_std": [1.0],
    }
