"""Run the notebooks of the documentation, and keep what they print and draw.

`uv run python tools/run_notebooks.py`

Cells are plain Python; they are run in order in one namespace, as a kernel of Jupyter would, in an empty
folder. What is kept: printed text, the value of the last line, and open figures.
"""

import ast
import base64
import io
import json
import os
import sys
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

import matplotlib as mpl

FOLDER = Path(__file__).parents[1] / "docs/guide/notebooks"
Notebook = dict[str, Any]


class CellError(Exception):
    """A cell failed; its cause says why."""


def read_notebook(path: Path) -> Notebook:
    """Return the content of a notebook."""
    notebook: Notebook = json.loads(path.read_text())
    return notebook


def executed(notebook: Notebook) -> Notebook:
    """Return the notebook with the outputs that its cells have now.

    Raises:
        CellError: a cell failed.
    """
    mpl.use("agg")
    namespace: dict[str, Any] = {"__name__": "__main__"}
    cells, count = [], 0
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                count += 1
                outputs = _outputs("".join(cell["source"]), count, namespace)
                cell = cell | {"execution_count": count, "outputs": outputs}
            cells.append(cell)
    return notebook | {"cells": cells}


def _outputs(source: str, count: int, namespace: dict[str, Any]) -> list[dict[str, Any]]:
    """Run a cell; return its outputs as notebooks keep them."""
    tree, printed = ast.parse(source), io.StringIO()
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    value, name = None, f"cell {count}"
    try:
        with redirect_stdout(printed):
            exec(compile(tree, name, "exec"), namespace)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), name, "eval"), namespace)
    except Exception as error:
        raise CellError(f"{name}:\n{source}\n{type(error).__name__}: {error}") from error
    outputs: list[dict[str, Any]] = []
    if text := printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)})
    if value is not None and not source.rstrip().endswith(";"):
        data = {"text/plain": repr(value).splitlines(keepends=True)}
        outputs.append({"output_type": "execute_result", "execution_count": count, "metadata": {}, "data": data})
    return outputs + _figures()


def _figures() -> list[dict[str, Any]]:
    """Return the open figures, and close them."""
    if "matplotlib.pyplot" not in sys.modules:
        return []
    plt = sys.modules["matplotlib.pyplot"]
    outputs = []
    for number in plt.get_fignums():
        file = io.BytesIO()
        plt.figure(number).savefig(file, format="png", dpi=80, bbox_inches="tight", metadata={"Software": ""})
        data = {"image/png": base64.b64encode(file.getvalue()).decode()}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    plt.close("all")
    return outputs


def main() -> None:
    """Run all notebooks, and write them with their outputs."""
    os.environ["OMP_NUM_THREADS"] = "1"
    for path in sorted(FOLDER.glob("*.ipynb")):
        print(path.name)
        written = executed(read_notebook(path))
        path.write_text(json.dumps(written, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
