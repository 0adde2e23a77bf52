import itertools
from dataclasses import replace

import numpy as np
import pytest
from small_cart import TASK
from torch import Tensor

from astra_data.reports.command_replay import can_replay, replay_commands
from astra_data.robots.nao.target import NaoEnv
from astra_data.robots.registry import TASKS
from astra_data.worlds.protocols import Step


def test_simulator_and_target_are_sent_the_same_commands_from_the_same_place() -> None:
    task = TASKS["nao-navigation"]
    replay = replay_commands(task)
    steps = len(replay.time_s)
    assert replay.time_s[0] == pytest.approx(task.timestep_s)
    assert replay.command.shape == (steps, 2)
    assert replay.simulated.shape == (steps, 4)
    assert replay.target.shape == (60, steps, 4)
    start = task.maze.cell_center(*task.maze.start)
    # 0.8 of 0.25 m/s for ten control steps of 0.192 s, and back again in the end.
    way = replay.simulated[:, :2] - replay.simulated[0, :2]
    assert way[9] == pytest.approx([0.2 * 9 * 0.192, 0.0], abs=1e-5)
    assert way[-1] == pytest.approx([-0.2 * 0.192, 0.0], abs=1e-5)
    assert replay.simulated[0, :2] == pytest.approx(start, abs=0.2)
    assert replay.target[:, 0, :2].mean(axis=0) == pytest.approx(start, abs=0.05)


def test_who_has_fallen_is_no_longer_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    task = TASKS["nao-navigation"]
    falls = {7: 3, 20: 0}  # step: robot
    step, steps = NaoEnv.step, itertools.count()

    def falling(self: NaoEnv, action: Tensor, active: Tensor | None = None) -> Step:
        outcome = step(self, action, active)
        self.failed[:] = False
        if (robot := falls.get(next(steps))) is not None:
            self.failed[robot] = True
        return outcome

    monkeypatch.setattr(NaoEnv, "step", falling)
    monkeypatch.setattr("astra_data.reports.command_replay._ROBOTS", 8)
    gone = np.isnan(replay_commands(task).target)
    expected = np.zeros_like(gone)
    expected[3, 8:] = expected[0, 21:] = True
    assert (gone == expected).all()


def test_only_targets_that_can_be_driven_from_the_start_cell_are() -> None:
    task = TASKS["nao-navigation"]
    assert can_replay(task) and can_replay(TASKS["antmaze-long"])
    assert not can_replay(TASKS["nao-kick"]) and not can_replay(TASKS["humanoid-walker2d"])
    assert not can_replay(replace(task, make_target=None))  # known from its logs alone
    assert not can_replay(TASK)
