import torch

from astra_data.robots.nao.kicking import BallAgent
from astra_data.worlds.plane.mazes import FIELD

START = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.22, 0.0, 0.0, 0.0])


def agents(count: int) -> BallAgent:
    return BallAgent(
        FIELD,
        count,
        timestep_s=0.2,
        radius_m=0.2,
        speed_m_s=0.25,
        reach_m=0.19,
        knock_m_s=1.0,
        kick_reach_m=0.3,
        kick_m_s=1.5,
    )


def test_a_correction_is_no_evidence_of_a_hit_where_nothing_touched_the_ball() -> None:
    """The first two balls are out of reach; the third is kicked, so that the correction tells."""
    agent, start = agents(3), START.repeat(3, 1)
    start[:2, 4] = 1.0
    agent.reset_to(start)
    agent.memory[:, 0] = 0.75
    landed = start.clone()
    landed[:, 6] = 0.22
    agent.step(torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert torch.equal(agent.settle(start, landed)[:, 4:], start[:, 4:])
    # A ball that is hit ends at 0.44 m/s, having left at 0.5 m/s: half of that is half of a hit.
    torch.testing.assert_close(agent.memory, torch.tensor([[0.75, 0.0], [0.75, 0.0], [0.75, 0.5]]))


def test_who_is_set_anew_leaves_the_memory_of_the_others_alone() -> None:
    agent = agents(6)
    agent.memory[:, 1] = 0.25
    before = agent.memory.clone()
    agent.reset_to(START.repeat(2, 1), torch.tensor([1, 4]))
    kept = [0, 2, 3, 5]
    assert torch.equal(agent.memory[kept], before[kept])
    assert (agent.memory[[1, 4], 0] != before[[1, 4], 0]).all() and not agent.memory[[1, 4], 1].any()
