from pathlib import Path

import pytest

from astra_data.reports.files import published_figures, read_published
from astra_data.reports.page import render
from astra_data.reports.sizes import SizesResults, render_sizes

PUBLISHED = Path(__file__).parents[2] / "recipes/results"
PREDICTIONS = {PUBLISHED / "nao_real.json"}
"""Of `astra-data gap`, whose pages are other ones."""


@pytest.mark.parametrize(
    "path", sorted({*PUBLISHED.glob("*.json")} - PREDICTIONS), ids=lambda path: path.stem
)
def test_a_published_page_is_what_its_numbers_give(path: Path) -> None:
    found = read_published(path)
    figures = {name: f"{path.stem}_{name}.png" for name in published_figures(PUBLISHED, path.stem)}
    page = render_sizes(found, figures) if isinstance(found, SizesResults) else render(found, figures)
    assert page == path.with_suffix(".md").read_text()
