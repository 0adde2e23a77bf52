import torch
from toy_episodes import toy_episodes

from astra_data.grounding.fit import residual_rewards
from astra_data.worlds.registry import TASKS


def test_residual_rewards_are_what_abstract_states_do_not_explain() -> None:
    """Steps: ahead, into the goal, failing unseen, into a goal that only abstract states show, none."""
    task = TASKS["antmaze-umaze"]
    goal = torch.tensor(task.maze.cell_centre(*task.maze.goal)).float()
    away, near, there = (goal + torch.tensor([shift, 0.0]) for shift in (2.0, 1.0, 0.0))
    after = torch.stack([near, there, near, there, goal])
    before = torch.stack([away, near, away, near, goal])
    terminated = torch.tensor([False, True, True, False, False])
    ahead = float(task.objective.reward(away[None], near[None], goal[None], torch.zeros(1, dtype=torch.bool)))
    assert 0.1 < ahead < 2.0
    going_on, failing = torch.tensor([[3.0, 0.0, 0.0, 2.0, 0.0]]), torch.tensor([[0.0, 0.0, -9.0, 0.0, 0.0]])
    still = torch.zeros(1, 5, 2)
    episodes = toy_episodes(
        torch.cat([before[None], still], dim=-1),
        still,
        next_state=torch.cat([after[None], still], dim=-1),
        goal=goal.expand(1, 5, 2),
        mask=torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]]),
        parts=torch.stack([going_on, failing], dim=-1),
        reward=going_on + failing,
        terminated=terminated[None],
    )
    residual = residual_rewards(task, episodes).windows.reward[0]
    torch.testing.assert_close(residual[:, 0], torch.tensor([3.0 - ahead, 0.0, 0.0, 0.0, 0.0]))
    torch.testing.assert_close(residual[:, 1], torch.tensor([0.0, 0.0, -9.0 - ahead, 0.0, 0.0]))
