import itertools
import json
from dataclasses import replace
from pathlib import Path

import fake_runs
import numpy as np
import pytest
import torch
from figures_shown import drawn
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from safetensors.numpy import save_file
from small_cart import TASK
from torch import Tensor

from astra_data.reports.figures.motion import can_replay, dynamics_mismatch, replay_commands, trajectories
from astra_data.reports.figures.style import DEPLOYED, SIMULATED, Scene
from astra_data.reports.results import Results
from astra_data.robots.nao.tasks import NaoEnv
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.protocols import Step
from astra_data.worlds.user_code import user_object

CART = Path(__file__).parents[3] / "recipes/examples/cart/cart.py"


def results(*rows: str) -> Results:
    return fake_runs.results(*(fake_runs.line(row, 0, success=1 / 3) for row in rows))


def paths() -> NDArray[np.float64]:
    target = np.full((3, 10, 2), np.nan)
    target[0] = np.linspace([-4, 4], [4, 4], 10)
    target[1, :4] = np.linspace([-4, 4], [0, 4], 4)
    target[2, :6] = np.linspace([-4, 4], [1, 4], 6)
    return target


def write(
    root: Path,
    row: str,
    *,
    goal: NDArray[np.float64] | None = None,
    ball: bool = False,
    simulated: bool = True,
    positions: tuple[int, int] = (2, 2),
) -> None:
    folder = root / f"evaluate/{row}/seed_0"
    folder.mkdir(parents=True)
    outcomes = {
        "success": [1, 0, 0],
        **{measure: [0, 1, 1] for measure in ("failed", "wall_contact", "steps", "return")},
    }
    values = {"task": "t", "method": row, "seed": 0, "episodes": 3, "target": outcomes}
    target = np.concatenate([paths(), paths() + 0.5], axis=-1) if ball else paths()[..., : positions[0]]
    tensors = {"target.position": target, "goal": np.full((3, 2), -4.0) if goal is None else goal}
    if simulated:
        values["simulated"] = outcomes
        tensors["simulated.position"] = paths()[..., : positions[1]]
    (folder / "evaluation.json").write_text(json.dumps(values))
    save_file(tensors, folder / "trajectories.safetensors")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path, replace(TASKS["antmaze-umaze"]), episodes=3)


def test_trajectories_draw_a_panel_per_method_with_crosses_where_episodes_fail(scene: Scene) -> None:
    assert trajectories(results("astra", "follower"), scene) is None
    write(scene.root, "astra")
    assert trajectories(results("astra", "follower"), scene) is None  # where a method has none, there is no figure
    write(scene.root, "follower", simulated=False)
    figure = drawn(trajectories(results("astra", "follower"), scene))
    assert [text.get_text() for text in figure.legends[0].get_texts()][1] == "in the target"
    astra, follower = figure.axes
    assert (astra.get_title(loc="left"), astra.get_title(loc="right")) == ("ASTRA", "0.33")
    assert follower.get_title(loc="left") == "Careful follower"
    solid = [line for line in astra.lines if line.get_linestyle() != "None"]
    looks = [(line.get_color(), line.get_linestyle()) for line in solid]
    assert looks == [(DEPLOYED, "-")] * 3 + [(SIMULATED, "--")] * 3
    crosses = [line for line in astra.lines if line.get_marker() == "x" and line.get_color() == DEPLOYED]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in crosses] == [(0.0, 4.0), (1.0, 4.0)]  # type: ignore[index]
    assert sum(line.get_marker() == "*" for line in astra.lines) == 1
    assert not [line for line in follower.lines if line.get_color() == SIMULATED]
    (walls,) = astra.collections
    assert len(walls.get_paths()) == len(U_MAZE.cells(walls=True))
    named = replace(scene, methods=("astra", "nas"))
    assert len(drawn(trajectories(results("astra", "follower"), named)).axes) == 1


def test_without_a_maze_paths_are_drawn_where_they_lead(scene: Scene) -> None:
    cart = replace(scene, task=user_object(f"{CART}:TASK"))
    write(scene.root, "astra", goal=np.zeros((3, 0)))
    write(scene.root, "nas", goal=np.zeros((3, 0)), simulated=False)
    astra, nas = drawn(trajectories(results("astra", "nas"), cart)).axes
    assert [line.get_color() for line in astra.lines if line.get_linestyle() != "None"] == [DEPLOYED] * 3 + [
        SIMULATED
    ] * 3
    # From -4 to 4 in x and at 4 in y, and a tenth around it.
    assert nas.get_xlim() == pytest.approx((-4.8, 4.8)) and nas.get_ylim() == pytest.approx((3.2, 4.8))
    assert not [line for line in astra.lines if line.get_marker() == "*"] and not astra.collections
    write(scene.root, "rma", goal=np.zeros((3, 0)), positions=(0, 0))
    humanoid = replace(scene, task=TASKS["humanoid-walker2d"])
    assert trajectories(results("rma"), humanoid) is None
    write(scene.root, "iql", goal=np.zeros((3, 0)), positions=(2, 0))  # a target that walks, of joints in a simulator
    (iql,) = drawn(trajectories(results("iql"), humanoid)).axes
    assert [line.get_color() for line in iql.lines if line.get_linestyle() != "None"] == [DEPLOYED] * 3
    assert cart.task.objective.places(torch.tensor([[0.5, -0.25, 1.0, 0.0]])).tolist() == [[0.5, -0.25]]


def test_a_star_stands_at_the_mean_goal_of_each_cell_and_a_ball_has_a_path_of_its_own(scene: Scene) -> None:
    goals = np.array([[-4.0, -4.0], [-3.0, -3.6], [4.0, 4.0]])
    write(scene.root, "astra", goal=goals, ball=True, simulated=False)
    (axes,) = drawn(trajectories(results("astra"), scene)).axes
    stars = [line.get_xydata() for line in axes.lines if line.get_marker() == "*"]
    assert np.concatenate(stars) == pytest.approx(np.array([[-3.5, -3.8], [4.0, 4.0]]))
    dotted = [line for line in axes.lines if line.get_linestyle() == ":"]
    np.testing.assert_allclose(np.asarray(dotted[0].get_xydata()), paths()[0] + 0.5)


def test_each_axis_of_a_mismatch_has_its_own_values_and_bands() -> None:
    time_s = np.array([0.1, 0.2, 0.3])
    simulated = np.tile([1.0, 2.0, 3.0, 4.0], (3, 1))
    shift = np.arange(101.0)[:, None, None] * np.array([1.0, 2.0, 0.0, 0.0])  # 101 robots, a meter apart in x, two in y
    command = np.tile([0.8, -0.5], (3, 1))
    target = simulated + shift
    target[1:, 2] = np.nan  # all but one have fallen before the last step, where the mean is its own
    figure = dynamics_mismatch(time_s, command, simulated, simulated + shift)
    x, y, speed, sent = figure.axes
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["x (m)", "y (m)", "speed (m/s)", "command (±1 per axis)"]
    assert [to_hex(str(line.get_color())) for line in x.lines] == [DEPLOYED.lower(), SIMULATED.lower()]
    assert np.asarray(speed.lines[1].get_ydata()) == pytest.approx(5.0)
    # A command holds during the step that ends at its time.
    assert [line.get_drawstyle() for line in sent.lines] == ["steps-pre"] * 2
    means = [dynamics_mismatch(time_s, command, simulated, target).axes[0].lines[0].get_ydata()]
    assert np.asarray(means)[0] == pytest.approx([51.0, 51.0, 1.0])
    for axes, at, apart in ((x, 1.0, 1.0), (y, 2.0, 2.0)):
        mean, one = (np.asarray(line.get_ydata()) for line in axes.lines)
        assert one == pytest.approx(at) and mean == pytest.approx(at + 50 * apart)
        for band, alpha, ends in zip(axes.collections, (0.18, 0.32), ((5, 95), (25, 75)), strict=True):
            heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
            assert band.get_alpha() == alpha
            assert [heights.min(), heights.max()] == pytest.approx([at + apart * end for end in ends])
    assert {line.get_linestyle(): np.asarray(line.get_ydata())[0] for line in sent.lines} == {"-": 0.8, ":": -0.5}


def test_simulator_and_target_are_sent_the_same_commands_from_the_same_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.reports.figures.motion._ROBOTS", 8)
    task = TASKS["nao-navigation"]
    time_s, command, simulated, target = replay_commands(task)
    steps = len(time_s)
    assert time_s[0] == pytest.approx(task.timestep_s) and command.shape == (steps, 2)
    assert simulated.shape == (steps, 4) and target.shape == (8, steps, 4)
    start = task.maze.cell_center(*task.maze.start)
    # 0.8 of 0.25 m/s for ten control steps of 0.192 s, and back again in the end.
    way = simulated[:, :2] - simulated[0, :2]
    assert way[9] == pytest.approx([0.2 * 9 * 0.192, 0.0], abs=1e-5)
    assert way[-1] == pytest.approx([-0.2 * 0.192, 0.0], abs=1e-5)
    assert simulated[0, :2] == pytest.approx(start, abs=0.2)
    assert target[:, 0, :2].mean(axis=0) == pytest.approx(start, abs=0.05)


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
    monkeypatch.setattr("astra_data.reports.figures.motion._ROBOTS", 8)
    gone = np.isnan(replay_commands(task)[3])
    expected = np.zeros_like(gone)
    expected[3, 8:] = expected[0, 21:] = True
    assert (gone == expected).all()


def test_only_targets_that_can_be_driven_from_the_start_cell_are() -> None:
    task = TASKS["nao-navigation"]
    assert can_replay(task) and can_replay(TASKS["antmaze-long"])
    assert not can_replay(TASKS["nao-kick"]) and not can_replay(TASKS["humanoid-walker2d"])
    assert not can_replay(replace(task, make_target=None))  # known from its logs alone
    assert not can_replay(TASK)
