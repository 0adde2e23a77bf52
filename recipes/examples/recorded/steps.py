"""Recorded rows → control steps of several rows: the dataset that a task without a target is fitted to."""

import numpy as np
import torch

from astra_data import Column, DatasetWriter, Episode, Objective
from astra_data.dataset.versions import home_of, open_dataset


class Recorded(Objective):
    """Nothing is asked for: logs are predicted, and no policy is trained."""

    def __init__(self, start, action_size):
        super().__init__(horizon=50)
        vars(self).update(start=start, action_size=action_size)

    def draw_starts(self, rng, count):
        return np.tile(self.start, (count, 1))

    def reached(self, state, goal):
        return torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def reward(self, before, after, goal, failed):
        return torch.zeros(len(before), device=before.device)


def write_steps(task, source, test=None, *, states, stretches, rows, share=0.25):
    """Write the dataset `NAME-steps` of `task`; a `share` of the stretches is held out, or all of `test`.

    Args:
        task: the task; its state is what `states` returns, its action the mean of the rows' actions.
        source: a dataset, by its name or folder. test: another, of the same columns.
        states: from recorded states (T + 2, S) at the ends of steps to those of the task, (T + 1, S').
        stretches: from recorded states (N, S) and their rate to (first, last) of rows that belong together.
    """
    columns = [task.state, task.action, Column("next.observation.state", size=task.state.size)]
    opened = [(open_dataset(part), part is test) for part in (source, test) if part]
    fps = int(opened[0][0].info["fps"]) // rows
    identity = {"name": f"{task.name}-steps", "version": "1.0.0"}
    description = {**identity, "stage": "steps", "parents": [dataset.identity for dataset, _ in opened]}
    rng, count = np.random.default_rng(0), 0
    settings = {"fps": fps, "task": task.instruction, "description": description}
    with DatasetWriter(root := home_of(identity), columns, **settings) as writer:
        for dataset, is_test in opened:
            for episode in dataset.episodes():
                state = episode.columns["observation.state"].astype(float)
                action = episode.columns.get("action", np.zeros((len(state), task.action.size)))
                for first, last in stretches(state, rows * fps):
                    held_out = is_test or (test is None and rng.random() < share)
                    # Of what is held out one copy: intervals resample episodes as if none resembled another.
                    for begin in range(first, first + (1 if held_out else rows)):
                        if (steps := (last - begin) // rows) < 3:
                            continue
                        ends = states(state[begin : begin + steps * rows + 1 : rows]).astype(np.float32)
                        each = action[begin + rows : begin + steps * rows].reshape(steps - 1, rows, -1)
                        values = {"observation.state": ends[:-1], "action": each.mean(1).astype(np.float32)}
                        values["next.observation.state"] = ends[1:]
                        metadata = {"held_out": bool(held_out)}
                        if begin > first:  # a copy, so that subsets take whole stretches
                            metadata["source_episode"] = count - (begin - first)
                        writer.add(Episode(count, values, metadata))
                        count += 1
    print(f"{root}: {count} episodes")
