from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_runs import FakeRecipe, edit_json, outcomes, write_runs
from matplotlib.figure import Figure
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from astra_data.core.errors import BadInputError
from astra_data.core.naming import seed_folder
from astra_data.reports.assembly import assemble
from astra_data.reports.drawing import Camera, figure_of_sizes, figures_of
from astra_data.reports.figures.style import DEPLOYED, SIMULATED
from astra_data.reports.schema import Learning, Results
from astra_data.reports.sizes import SizeResults, SizesResults
from astra_data.reports.statistics import Summary
from astra_data.worlds.plane.mazes import U_MAZE, Maze
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield write_runs(tmp_path_factory.mktemp("drawing"))


@pytest.fixture(scope="module")
def results(root: Path) -> Results:
    return assemble(FakeRecipe(), root=root, command="", replicates=10)


def drawn(
    results: Results,
    root: Path,
    maze: Maze | None = None,
    camera: Camera | None = None,
    methods: tuple[str, ...] = (),
) -> dict[str, Figure]:
    return figures_of(
        results, root, maze=maze, camera=camera, trajectory_methods=methods, trajectory_episodes=2
    )


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes]


def test_bars_and_diamonds_are_the_summaries(results: Results, root: Path) -> None:
    (axes,) = drawn(results, root)["success"].axes
    rows = results.methods.values()
    assert [bar.get_width() for bar in axes.patches] == [  # type: ignore[attr-defined]
        row.summary["success"].iqm for row in rows
    ]
    diamonds = [line for line in axes.lines if line.get_marker() == "D"]
    assert [float(np.asarray(line.get_xdata())[0]) for line in diamonds] == [0.75] * 3
    intervals = [line for line in axes.lines if line.get_marker() == "None"]
    astra = results.methods["astra"].summary["success"]
    assert np.asarray(intervals[1].get_xdata()).tolist() == [astra.low, astra.high]


def test_a_figure_is_drawn_of_what_there_is(results: Results, root: Path, tmp_path: Path) -> None:
    assert list(drawn(results, root, U_MAZE)) == ["success", "trajectories", "learning", "gap", "validity"]
    assert "trajectories" not in drawn(results, tmp_path, U_MAZE)
    bare = {
        name: row.model_copy(update={"gap": None, "learning": []}) for name, row in results.methods.items()
    }
    nothing = results.model_copy(update={"methods": bare, "predictive_validity": {}})
    assert list(drawn(nothing, root)) == ["success"]
    lasting = results.model_copy(update={"scores": (SURVIVED_STEPS, SUCCESS)})
    assert list(drawn(lasting, root))[:3] == ["steps", "success", "learning_steps"]


def test_trajectories_are_of_the_rows_asked_for_that_are_reported(results: Results, root: Path) -> None:
    (panel,) = drawn(results, root, U_MAZE, methods=("nas", "astra"))["trajectories"].axes
    assert (panel.get_title(loc="left"), panel.get_title(loc="right")) == ("ASTRA", "0.50")
    # Two episodes in each world.
    assert sum(line.get_linestyle() in ("-", "--") for line in panel.lines) == 4
    every = drawn(results, root, U_MAZE, methods=("nas",))["trajectories"]
    assert titles(every) == [row.title for row in results.methods.values()]


def test_rows_without_a_finite_score_have_no_learning_curve(results: Results, root: Path) -> None:
    unknown = Learning(steps=[0.0, 1.0], score=[float("nan")] * 2)
    row = results.methods["astra"]
    rows = results.methods | {"astra": row.model_copy(update={"learning": [*row.learning, unknown]})}
    shown = drawn(results.model_copy(update={"methods": rows}), root)["learning"]
    assert titles(shown)[:2] == ["Direct transfer", "ASTRA"]
    first, astra = shown.axes[:2]
    assert (len(first.lines), len(astra.lines)) == (1, 1)  # ASTRA+ alone
    steps, success = np.asarray(first.lines[0].get_data())
    assert (steps[0], steps[-1], success[0], success[-1]) == (1000, 2000, 0.5, 0.75)


def test_validity_has_a_panel_for_each_simulator(results: Results, root: Path) -> None:
    raw, grounded = drawn(results, root)["validity"].axes
    assert (raw.get_title(loc="left"), grounded.get_title(loc="left")) == (
        "Raw simulator",
        "Grounded simulator",
    )
    dots = np.asarray(raw.lines[1].get_xydata()).tolist()
    # Simulated and target return of the seeds 0, 1 and 2.
    assert dots == [[0, 0], [1, 1], [4, 2]]
    assert (len(raw.lines), len(grounded.lines)) == (1 + 4, 1 + 3)


def test_gaps_are_drawn_once_for_rows_that_share_a_grounding(results: Results, root: Path) -> None:
    (axes,) = drawn(results, root)["gap"].axes
    raw, grounded = axes.lines
    assert np.asarray(raw.get_xydata()).tolist() == [[1, 1], [10, 2]]
    assert np.asarray(grounded.get_ydata()) == pytest.approx([0.2, 0.4])


def test_pictures_are_taken_at_the_same_times_until_the_end(results: Results, tmp_path: Path) -> None:
    root = write_runs(tmp_path)
    for number, row in enumerate(("astra", "follower")):
        states = np.arange(5.0 + 40 * number)[:, None]
        folder = root / f"evaluate/{row}/seed_0"
        save_file({"target.state": states}, folder / "trajectories.safetensors")
        failed = {"success": [0.0] * 4, "failed": [1.0] * 4, "wall_contact": [0.0] * 4, "steps": [9.0] * 4}
        if row == "follower":
            edit_json(folder / "evaluation.json", target=failed | {"return": [0.0] * 4})
    seen: list[list[float]] = []

    def photograph(states: NDArray[np.float64]) -> NDArray[np.uint8]:
        seen.append(states[:, 0].tolist())
        return np.zeros((len(states), 4, 4, 3), np.uint8)

    camera = Camera(photograph, timestep_s=0.25, longest_s=3.0)
    figure = drawn(results, root, None, camera, ("astra", "follower"))["strips"]
    # At 0, 0.5, 1, 1.5, 2 s, and 3 s, when time is up.
    assert seen == [[0, 2, 4], [0, 2, 4, 6, 8, 12]]
    texts = [[text.get_text() for text in axes.texts] for axes in figure.axes[::6]]
    assert texts == [["ASTRA", "1 s"], ["Careful follower", "fell after 11.0 s"]]

    def fail(states: NDArray[np.float64]) -> NDArray[np.uint8]:
        raise BadInputError("no display")

    assert "strips" not in drawn(results, root, None, Camera(fail, 0.25, 3.0), ("astra",))


def test_sizes_are_mapped_where_all_datasets_of_a_seed_are_there(results: Results, tmp_path: Path) -> None:
    found = SizesResults(
        recipe="toy",
        task="maze",
        command="",
        sizes=[SizeResults(percent=percent, results=results) for percent in (50, 100)],
    )
    write_fake(tmp_path / "subset" / seed_folder(1, 50))
    assert len(figure_of_sizes(found, tmp_path).axes) == 1
    write_fake(tmp_path / "subset" / seed_folder(1, 100))
    figure = figure_of_sizes(found, tmp_path)
    maps = [axes for axes in figure.axes if axes.images]
    assert [axes.get_title() for axes in maps[:2]] == ["50 %", "100 %"]
    labels = [axes.get_ylabel() for axes in maps if axes.get_ylabel()]
    assert labels == ["position (m)"], labels
    lines = figure.axes[-1].lines
    astra = results.methods["astra"].summary["success"].iqm
    assert np.asarray(lines[2].get_xydata()).tolist() == [[50, astra], [100, astra]]


def test_crosses_stand_where_episodes_fail_in_either_world(results: Results, tmp_path: Path) -> None:
    folder = write_runs(tmp_path) / "evaluate/astra/seed_0"
    edit_json(
        folder / "evaluation.json", target=outcomes([1, 0, 0, 0], 0), simulated=outcomes([0, 1, 1, 1], 0)
    )
    tensors = load_file(folder / "trajectories.safetensors")
    tensors["target.position"][1, :, 1] = tensors["simulated.position"][1, :, 1] = 0.0
    save_file(tensors, folder / "trajectories.safetensors")
    (panel,) = drawn(results, folder.parents[2], U_MAZE, methods=("astra",))["trajectories"].axes
    crosses = {
        color: [
            np.asarray(line.get_xydata())[0].tolist()
            for line in panel.lines
            if line.get_marker() == "x" and line.get_color() == color
        ]
        for color in (DEPLOYED, SIMULATED)
    }
    assert crosses == {DEPLOYED: [[4, 0]], SIMULATED: [[4, 4]]}


def test_bars_are_interquartile_means_and_diamonds_and_numbers_of_panels_are_means(
    results: Results, root: Path
) -> None:
    """Of three seeds, as the toy rows have them, both are the same."""
    apart = {
        "success": Summary(0.4, 0.1, 0.6, 0.5, 0.7),
        "simulated_success": Summary(0.8, 0.1, 0.9, 0.8, 1.0),
    }
    rows = {
        name: row.model_copy(update={"summary": row.summary | apart}) for name, row in results.methods.items()
    }
    found = results.model_copy(update={"methods": rows})
    figures = drawn(found, root, U_MAZE)
    (bars,) = figures["success"].axes
    assert {bar.get_width() for bar in bars.patches} == {0.6}  # type: ignore[attr-defined]
    diamonds = [line for line in bars.lines if line.get_marker() == "D"]
    assert {float(np.asarray(line.get_xdata())[0]) for line in diamonds} == {0.8}
    assert {axes.get_title(loc="right") for axes in figures["trajectories"].axes} == {"0.40"}
    sizes = [SizeResults(percent=100, results=found)]
    lines = (
        figure_of_sizes(SizesResults(recipe="toy", task="maze", command="", sizes=sizes), root).axes[0].lines
    )
    assert np.asarray(lines[0].get_xydata()).tolist() == [[100, 0.6]]


def test_no_figure_is_of_the_target_where_nothing_was_tested_there(results: Results, root: Path) -> None:
    found = results.model_copy(update={"tested_in": "simulators"})
    figures = drawn(found, root, U_MAZE)
    assert figures["success"].axes[0].get_xlabel() == "success rate in a simulator"
    assert figures["trajectories"].legends[0].get_texts()[1].get_text() == "in a simulator"
    sizes = [SizeResults(percent=100, results=found)]
    figure = figure_of_sizes(SizesResults(recipe="toy", task="maze", command="", sizes=sizes), root)
    assert figure.axes[0].get_ylabel() == "success rate in a simulator"
