"""Whether a ball is hit: the share of the simulator's velocity that comes true, or of one that lies, any move."""

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.grounding import history
from astra_data.grounding.descent import DescentConfig
from astra_data.grounding.history import HistoryGrounding, fit_hits, fit_scatter
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, correction_r2
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.robots.registry import TASKS

EPISODES, STEPS = 40, 30
REACH_M, SHARE = 0.2, 0.4
LATENT_ALONE = LossWeights(latent=0.0, reward=0.0)


@pytest.fixture(autouse=True)
def _all_is_fitted_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, updates in (("_DESCENT", 100), ("_HITS_DESCENT", 700)):
        monkeypatch.setattr(history, name, DescentConfig(updates=updates, learning_rate=2e-3))


def ball_model() -> GroundingModel:
    torch.manual_seed(0)
    return GroundingModel(GroundingShape(8, 3, 2, latent_size=8, position_octaves=0, ball_index=4, ball_rolls=True))


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


def test_hits_are_fitted_by_their_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "_HITS_DESCENT", DescentConfig(updates=2, learning_rate=2e-3))
    training, fitted = kicks(), list[torch.Tensor]()
    for seed in (0, 0, 1):
        model = ball_model()
        torch.manual_seed(len(fitted))
        fit_hits(model, training, seed=seed)
        fitted.append(torch.cat([values.flatten() for values in model.state_dict().values()]))
    assert torch.equal(fitted[0], fitted[1]) and not torch.equal(fitted[0], fitted[2])


def test_without_a_rolling_ball_there_is_nothing_to_fit() -> None:
    model, training = ball_model(), kicks()
    training.windows.simulated_next[..., 6:] = 0.0
    before = {name: values.clone() for name, values in model.state_dict().items()}
    fit_hits(model, training, seed=0)
    assert all(values.equal(before[name]) for name, values in model.state_dict().items())
    assert GroundingModel(GroundingShape(6, 3, 2, ball_index=2, ball_rolls=True)).hits is not None
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
    assert torch.equal(simulator.step(torch.tensor([0.0, 0.0, 1.0]).expand(500, 3))[:, 4:], state[:, 4:])


CONTACT_M, PUSHED_M = 0.06, 0.02


def pushes(seed: int = 0) -> PairedEpisodes:
    """Steps in which a gripper pushes a puck within 0.06 m ahead, while the simulator leaves all where it is."""
    torch.manual_seed(seed)
    distance, angle = 0.3 * torch.rand(EPISODES, STEPS, 1), 7 * torch.rand(EPISODES, STEPS, 1)
    way = torch.cat([angle.cos(), angle.sin()], dim=-1)
    gripper = torch.randn(EPISODES, STEPS, 2)
    state = torch.cat([gripper, gripper + distance * way], dim=-1)
    after = state + torch.cat([0.02 * torch.randn_like(way), PUSHED_M * way * (distance < CONTACT_M)], dim=-1)
    return toy_episodes(state, torch.ones(EPISODES, STEPS, 2), simulated_next=state, next_state=after)


def puck_model() -> GroundingModel:
    torch.manual_seed(0)
    return GroundingModel(GroundingShape(4, 2, 2, latent_size=8, position_octaves=0, ball_index=2))


def test_a_ball_that_lies_moves_where_it_is_touched_alone() -> None:
    model, training = puck_model(), pushes()
    model.correction_std.fill_(PUSHED_M / 2)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(200):
        loss, parts = model.losses(training.windows, LATENT_ALONE)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(loss, parts["state"] + parts["touched"])
    model.requires_grad_(False)
    windows = pushes(1).windows
    latent, _ = model.encode(windows)
    inputs = model.correction_inputs(latent, windows.action, windows.simulated_next)
    distance = (windows.state[..., 2:] - windows.state[..., :2]).norm(dim=-1)
    near, far = distance < 0.8 * CONTACT_M, distance > 1.5 * CONTACT_M
    moved = (model.corrected(inputs, windows.simulated_next) - windows.state)[..., 2:].norm(dim=-1)
    assert 0.6 * PUSHED_M < float(moved[near].mean()) < 1.1 * PUSHED_M and float(moved[far].max()) < PUSHED_M / 20
    changed = model.changed(inputs, torch.ones_like(windows.state))
    assert float(changed[near][..., 2:].mean()) > 0.9 and float(changed[far][..., 2:].max()) < 0.02
    assert torch.equal(changed[..., :2], torch.ones_like(changed[..., :2]))
    scatter, _ = fit_scatter(model, training, pushes(1), seed=0)
    assert model.touched is not None
    list(model.touched.parameters())[-1].fill_(-200.0)  # none is touched
    simulator = HistoryGrounding(model, scatter_model=scatter).simulator(TASKS["antmaze-umaze"], 100)
    state = torch.tensor([0.0, 0.0, 0.3, 0.0]).expand(100, 4)
    simulator.start(state, torch.arange(100), torch.zeros(100, 2))
    after = simulator.step(torch.zeros(100, 2))
    landed = TASKS["antmaze-umaze"].simulator(100)
    landed.reset_to(state)
    assert torch.equal(after[:, 2:], landed.step(torch.zeros(100, 2))[:, 2:]) and after[:, 0].unique().numel() > 50


def test_which_shapes_have_a_ball_that_lies() -> None:
    assert puck_model().touched is not None and puck_model().hits is None
    assert ball_model().touched is None and ball_model().shape.lying_ball is None
    plain = GroundingModel(GroundingShape(4, 2, 2))
    assert plain.touched is None and plain.changed(torch.zeros(1, 1), torch.ones(1, 4)).equal(torch.ones(1, 4))
