import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, correction_r2, telemetry
from astra_data.grounding.paired_episodes import PairedEpisodes

WEIGHTS = LossWeights()


def episodes() -> PairedEpisodes:
    """Return four episodes of 12 steps; the last has only 7, and other numbers in its padding.

    The first and the last fail, the second succeeds.
    """
    torch.manual_seed(0)
    state, error = torch.randn(4, 12, 4), 0.1 * torch.randn(4, 12, 4)
    mask = torch.ones(4, 12)
    mask[3, 7:] = 0.0
    failed = torch.zeros(4, 12)
    failed[0, -1] = failed[3, 6] = 1.0
    reward = torch.randn(4, 12) - 9.0 * failed
    ended = failed.bool()
    ended[1, -1], reward[1, -1] = True, 40.0
    spoiled = 1e3 * (1.0 - mask).unsqueeze(-1)
    return toy_episodes(
        state,
        torch.randn(4, 12, 2),
        next_state=state + error + spoiled,
        simulated_next=state,
        goal=torch.randn(4, 12, 2),
        mask=mask,
        reward=reward + spoiled[..., 0],
        failed=failed,
        terminated=ended,
    )


def model(given: PairedEpisodes) -> GroundingModel:
    torch.manual_seed(1)
    made = GroundingModel(
        GroundingShape(4, 2, 2, latent_size=6, head_sizes=(8,), position_octaves=0, corrects_reward=False)
    )
    windows = given.windows
    made.set_reward_scales(
        given.steps(windows.reward)[:, None], given.steps(windows.goes_on), given.steps(windows.failed)
    )
    list(made.correction.parameters())[-2].data.normal_(std=0.05)
    return made.requires_grad_(False)


def r2(predicted: torch.Tensor, true: torch.Tensor) -> float:
    return float(1.0 - (predicted - true).square().sum() / (true - true.mean(0)).square().sum())


def test_shares_of_variance_are_those_of_real_steps() -> None:
    given = episodes()
    used, windows, real = model(given), given.windows, given.windows.mask.bool()
    figures = telemetry(used, given, WEIGHTS)
    latent, _ = used.encode(windows)
    predicted, reward = used.predict_reward(latent, windows.action), windows.reward
    paid = real & (reward > -5.0) & (reward < 40.0)
    assert int(real.sum() - paid.sum()) == 3
    assert figures["r2_reward"] == pytest.approx(r2(predicted[paid], reward[paid]), rel=1e-4)
    mean, _ = used.predict_latent(latent[:, :-1], windows.action[:, :-1])
    both = real[:, 1:]
    assert figures["r2_latent"] == pytest.approx(r2(mean[both], latent[:, 1:][both]), rel=1e-4)
    corrected = used.correct(latent, windows.action, windows.simulated_next)
    assert figures["r2_state"] == correction_r2(corrected, windows, used.correction_std)


def test_the_latents_spread_and_rank() -> None:
    given = episodes()
    used = model(given)
    samples = used.encode(given.windows)[0][given.windows.mask.bool()]
    figures = telemetry(used, given, WEIGHTS)
    assert figures["latent_std"] == pytest.approx(float(samples.std(0).mean()), rel=1e-5)
    shares = torch.linalg.svdvals(samples - samples.mean(0)).square()
    shares = shares / shares.sum()
    rank = float((-(shares * shares.clamp_min(1e-30).log()).sum()).exp())
    assert figures["latent_rank"] == pytest.approx(rank, rel=1e-3) and 1.0 < rank < 6.0


def test_a_fit_that_diverged_is_told() -> None:
    used = model(episodes())
    next(used.encoder.parameters()).data.fill_(torch.nan)
    with pytest.raises(BadInputError, match=r"the fit diverged: lower learning_rate in \[ground\]"):
        telemetry(used, episodes(), WEIGHTS)
