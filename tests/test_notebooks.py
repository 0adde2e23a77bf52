"""The notebooks of the documentation run, and show what their cells print now; only figures may differ."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from run_notebooks import FOLDER, CellError, Notebook, executed, read_notebook

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.fixture(autouse=True)
def put_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo what notebooks set for the process that runs them."""
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path))
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def notebook(*cells: str) -> Notebook:
    return {"cells": [{"cell_type": "code", "source": [cell], "outputs": []} for cell in cells]}


def outputs(content: Notebook) -> list[list[tuple[str, str]]]:
    """Return kind and text, without numbers, of the outputs of each cell of code."""

    def shown(output: dict[str, Any]) -> tuple[str, str]:
        text = "".join(output.get("text", output.get("data", {}).get("text/plain", [])))
        return output["output_type"], re.sub(r"\d[\d.]*", "0", text)

    return [[*map(shown, cell["outputs"])] for cell in content["cells"] if cell["cell_type"] == "code"]


def shortened(content: Notebook) -> Notebook:
    """Return the notebook with trainings too short to learn anything: what it prints differs in figures."""

    def cell(kept: dict[str, Any]) -> dict[str, Any]:
        source = "".join(kept["source"])
        few = {
            "updates": "4",
            "episodes": "30",
            "EvaluateConfig(episodes": "4",
            "total_steps": "512, num_envs=16, tries=1",
        }
        for name, least in few.items():
            source = re.sub(rf"(?<!\w){re.escape(name)}=[\d_]+", f"{name}={least}", source)
        return kept | {"source": source.splitlines(keepends=True)}

    return content | {"cells": [cell(kept) for kept in content["cells"]]}


@pytest.mark.usefixtures("quick_fits")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_a_notebook_runs_and_shows_what_it_prints(path: Path) -> None:
    kept = read_notebook(path)
    assert (kept["nbformat"], kept["metadata"]["kernelspec"]["name"]) == (4, "python3"), "Jupyter opens it"
    made = executed(shortened(kept))
    assert outputs(made) == outputs(kept), "run tools/run_notebooks.py and commit what it writes"


def test_a_cell_that_fails_is_named() -> None:
    with pytest.raises(CellError, match="cell 2:\nvalue \\+ missing\nNameError: name 'missing'"):
        executed(notebook("value = 1", "value + missing", "value"))
    with pytest.raises(CellError, match="cell 1:\nassert 1 == 2\nAssertionError"):
        executed(notebook("assert 1 == 2"))


def test_cells_share_names_and_keep_text_values_and_figures() -> None:
    drawn = "import matplotlib.pyplot as plt\nplt.plot([0, 1]);"
    made = executed(notebook("value = 2\nprint('two')", "value + 1", drawn, "value;"))
    first, second, third, fourth = (cell["outputs"] for cell in made["cells"])
    assert first == [{"output_type": "stream", "name": "stdout", "text": ["two\n"]}]
    assert [output["data"] for output in second] == [{"text/plain": ["3"]}]
    assert [[*output["data"]] for output in third] == [["image/png"]] and fourth == []
    assert [cell["execution_count"] for cell in made["cells"]] == [1, 2, 3, 4]
