"""Algorithm 1 of the paper taken literally, to be timed: an update per trajectory, a turn per step."""

from itertools import cycle

import torch
from timing import Stretch

from astra_data.grounding.fit import GroundConfig
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights
from astra_data.grounding.paired_episodes import PairedEpisodes


def step_by_step(
    shape: GroundingShape, weights: LossWeights, episodes: PairedEpisodes, config: GroundConfig
) -> Stretch:
    """Learn from one trajectory after another; each call returns the windows' worth of steps of one."""
    model = GroundingModel(shape)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    order = cycle(range(len(episodes)))

    def stretch() -> float:
        number = next(order)
        windows, length = episodes.select(torch.tensor([number])).windows, int(episodes.lengths[number])
        hidden, loss = torch.zeros(1, shape.latent_size), torch.zeros(())
        expected: tuple[torch.Tensor, torch.Tensor] | None = None
        for step in range(length):
            state, action, goal = (
                values[:, step] for values in (windows.state, windows.action, windows.goal)
            )
            seen = model.encoder_input(state, goal, windows.previous_action[:, step])
            hidden = model.encoder.step(seen, hidden)
            latent = model.encoder.latent(hidden)
            if expected is not None:
                mean, log_variance = expected
                nll = (latent - mean).square() / log_variance.exp() + log_variance
                loss = loss + weights.latent * 0.5 * nll.mean()
            expected = model.predict_latent(latent, action)
            reward = model.predict_reward(latent, action)
            loss = loss + weights.reward * (reward - windows.reward[:, step]).square().mean()
            corrected = model.correct(latent, action, windows.simulated_next[:, step])
            loss = loss + weights.state * (corrected - windows.next_state[:, step]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return length / config.window

    return stretch
