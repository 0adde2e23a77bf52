"""Whether a ball is hit: the share of the simulator's velocity of it that comes true."""

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.grounding.history import HistoryGrounding, fit_hits, fit_scatter
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, correction_r2
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.robots.registry import TASKS

EPISODES, STEPS = 40, 30
REACH_M, SHARE = 0.2, 0.4
LATENT_ALONE = LossWeights(latent=0.0, reward=0.0)


def ball_model() -> GroundingModel:
    torch.manual_seed(0)
    return GroundingModel(GroundingShape(8, 3, 2, latent_size=8, position_octaves=0, ball_index=4))


def kicks(seed: int = 0) -> PairedEpisodes:
    """Kicks that reach a ball within 0.35 m in the simulator, and in two of five cases one within 0.2 m in truth."""
    torch.manual_seed(seed)
    distance, angle = 0.15 + 0.25 * torch.rand(EPISODES, STEPS, 1), 7 * torch.rand(EPISODES, STEPS, 1)
    way = torch.cat([angle.cos(), angle.sin()], dim=-1)
    robot = torch.randn(EPISODES, STEPS, 2)
    still = torch.zeros(EPISODES, STEPS, 2)
    state = torch.cat([robot, still, robot + distance * way, still], dim=-1)
    simulated, after = state.clone(), state.clone()
    simulated[..., 6:] = way * (distance < 0.35)
    is_hit = (distance < REACH_M) & (torch.rand_like(distance) < SHARE)
    after[..., 6:] = torch.where(is_hit, way, 0.02 * torch.randn_like(way))
    action = torch.ones(EPISODES, STEPS, 3)
    return toy_episodes(state, action, simulated_next=simulated, next_state=after)


def test_the_share_of_hits_is_told_by_the_distance() -> None:
    model, training = ball_model(), kicks()
    before = {name: values.clone() for name, values in model.state_dict().items()}
    fit_hits(model, training, seed=0)
    changed = {name.split(".")[0] for name, values in model.state_dict().items() if not values.equal(before[name])}
    assert changed == {"hits"}
    windows = kicks(1).windows
    latent, _ = model.encode(windows)
    corrected = model.correct(latent, windows.action, windows.simulated_next)[..., 6:].detach()
    distance = (windows.state[..., 4:6] - windows.state[..., :2]).norm(dim=-1)
    rolls = windows.simulated_next[..., 6:].any(-1)
    speed = corrected.norm(dim=-1)
    assert float(speed[rolls & (distance < 0.18)].mean()) == pytest.approx(SHARE, abs=0.1)
    assert float(speed[rolls & (distance > 0.24)].mean()) < 0.05 and not speed[~rolls].any()
    along = torch.nn.functional.cosine_similarity(corrected[rolls], windows.simulated_next[..., 6:][rolls], dim=-1)
    torch.testing.assert_close(along, torch.ones_like(along))
    torch.manual_seed(5)
    other = ball_model()
    fit_hits(other, training, seed=0)
    assert all(map(torch.equal, model.state_dict().values(), other.state_dict().values()))


def test_without_a_rolling_ball_there_is_nothing_to_fit() -> None:
    model, training = ball_model(), kicks()
    training.windows.simulated_next[..., 6:] = 0.0
    before = {name: values.clone() for name, values in model.state_dict().items()}
    fit_hits(model, training, seed=0)
    assert all(values.equal(before[name]) for name, values in model.state_dict().items())
    assert GroundingModel(GroundingShape(6, 3, 2, ball_index=2)).hits is not None
    assert GroundingModel(GroundingShape(8, 3, 2, ball_index=2)).hits is None


def test_the_other_corrections_do_not_learn_from_the_speed_of_balls() -> None:
    model, windows = ball_model(), kicks().windows
    windows.next_state[..., :4] += 1.0
    loss, parts = model.losses(windows, LATENT_ALONE)
    error = ((windows.simulated_next - windows.next_state) / model.correction_std)[..., :6].square().mean()
    torch.testing.assert_close(parts["state"], error)
    loss.backward()
    assert not any(one.grad.any() for name, one in model.named_parameters() if "hits" in name and one.grad is not None)
    # What explains all but the speed of balls explains everything.
    assert correction_r2(windows.next_state + torch.tensor([0.0] * 6 + [9.0] * 2), windows, model) == 1.0


def test_scatter_sets_no_ball_rolling() -> None:
    model = ball_model().requires_grad_(False).eval()
    assert model.hits is not None
    scatter, figures = fit_scatter(model, kicks(), kicks(1), seed=0)
    assert not scatter.usual[6:].any() and scatter.usual[:6].all()
    assert all(torch.tensor(value).isfinite() for value in figures.values())
    list(model.hits.parameters())[-1].fill_(-20.0)  # none is hit
    task = TASKS["nao-kick"]
    simulator = HistoryGrounding(model, scatter_model=scatter).simulator(task, 500)
    state = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0]).expand(500, 8)
    simulator.start(state, torch.arange(500), torch.zeros(500, 2))
    after = simulator.step(torch.tensor([0.0, 0.0, 1.0]).expand(500, 3))
    assert torch.equal(after[:, 4:], state[:, 4:])
