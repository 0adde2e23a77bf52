"""What a task computes on "meta", a device without values that refuses tensors of the CPU beside its own."""

import torch

from astra_data.worlds.task import Task


def places(task: Task) -> set[str]:
    """Return on which devices its objective's answers lie, where states, goals and failures lie on "meta"."""
    objective = task.objective
    state = torch.empty(3, task.abstract_state.size, device="meta")
    goal = torch.empty(3, objective.goal_size, device="meta")
    failed = torch.empty(3, dtype=torch.bool, device="meta")
    answers = (
        objective.observe(state, goal),
        objective.reached(state, goal),
        objective.missed(state, goal),
        objective.reward(state, state, goal, failed),
    )
    return {answer.device.type for answer in answers}
