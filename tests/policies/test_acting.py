import math

import pytest
import torch
from toy_worlds import ConstantReward, GoToZero

from astra_data.policies.learner import Acting
from astra_data.worlds.protocols import BatchedEnv


def acting(env: BatchedEnv, horizon: int, *, is_staggered: bool = False) -> Acting:
    return Acting(env, torch.ones(env.num_envs, 3), horizon=horizon, is_staggered=is_staggered)


def take(rows: Acting) -> tuple[torch.Tensor, torch.Tensor]:
    """Take a step too wide; return who expired and who is done."""
    taken = rows.take(torch.full((rows.env.num_envs, 1), 1.5), torch.ones(rows.env.num_envs, 3))
    assert torch.equal(taken.action, torch.ones(rows.env.num_envs, 1))
    return taken.expired, taken.done


@pytest.mark.parametrize(("length", "horizon", "expires"), [(4.0, 9, False), (9.0, 4, True), (4.0, 4, False)])
def test_episodes_end_by_themselves_or_by_the_horizon(length: float, horizon: int, *, expires: bool) -> None:
    rows = acting(ConstantReward(2, length), horizon)
    for step in range(1, 9):
        expired, done = take(rows)
        over = step % 4 == 0
        assert done.tolist() == [over] * 2
        assert expired.tolist() == [over and expires] * 2
        assert rows.first.tolist() == [over] * 2
        # What an episode before this one did and remembered is gone.
        assert rows.previous_action.squeeze(-1).tolist() == [float(not over)] * 2
        assert rows.hidden.tolist() == [[float(not over)] * 3] * 2
    success = 0.0 if expires else 1.0
    assert rows.figures() == {"success": success, "episode_steps": 4.0, "episodes": 4.0, "reward": 1.0}
    take(rows)
    figures = rows.figures()
    assert figures["episodes"] == 0
    assert math.isnan(figures["success"]) and math.isnan(figures["episode_steps"])


def test_at_random_ages_not_all_expire_at_once() -> None:
    torch.manual_seed(0)
    rows = acting(GoToZero(1000), 10, is_staggered=True)
    expired = [int(take(rows)[0].sum()) for _ in range(20)]
    assert min(expired) > 60 and max(expired) < 140
    assert expired[:10] == expired[10:]


def test_going_on_is_as_never_having_stopped() -> None:
    torch.manual_seed(0)
    world, other = ConstantReward(50, math.inf), ConstantReward(50, math.inf)
    rows = acting(world, 7, is_staggered=True)
    take(rows)
    rows.figures()
    resumed = acting(other, 7, is_staggered=True)
    resumed.load_state_dict(rows.state_dict(), other.load_state_dict(world.state_dict()))
    for _ in range(10):
        assert torch.equal(take(rows)[1], take(resumed)[1])
    assert rows.figures() == resumed.figures()
