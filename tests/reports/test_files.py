from collections.abc import Mapping
from pathlib import Path

import pytest
from fake_runs import bare_results

from astra_data.core.errors import BadInputError
from astra_data.reports.files import (
    check_none_lost,
    publish_results,
    published_figures,
    read_published,
    write_results,
)
from astra_data.reports.schema import Results

PUBLISHED = Path(__file__).parents[2] / "recipes/results"
OTHERS = {"nao_real", "ablation"}
"""Of `astra-data gap`; and written when curves had no other scores than success."""

TOY = bare_results("toy", {"astra": [0, 1]}, {"x": [1.5, 2.0]})


def page(figures: Mapping[str, str]) -> str:
    return f"figures: {dict(figures)}"


@pytest.mark.parametrize(
    "path",
    sorted(path for path in PUBLISHED.glob("*.json") if path.stem not in OTHERS),
    ids=lambda path: path.stem,
)
def test_published_results_are_written_as_they_were_read(path: Path, tmp_path: Path) -> None:
    write_results(read_published(path), page, {}, tmp_path, "again")
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_a_list_of_numbers_takes_one_line(tmp_path: Path) -> None:
    write_results(TOY, page, {}, tmp_path, "results")
    text = (tmp_path / "results.json").read_text()
    assert '"seeds": [ 0, 1 ]' in text and '"x": [ 1.5, 2.0 ]' in text and text.endswith("}\n")
    assert Results.model_validate_json(text) == TOY


def test_texts_in_a_list_are_kept_to_the_letter(tmp_path: Path) -> None:
    settings = {"data": ["my  walks", "day\N{NO-BREAK SPACE}2"]}
    results = TOY.model_copy(update={"settings": settings})
    write_results(results, page, {}, tmp_path, "results")
    assert Results.model_validate_json((tmp_path / "results.json").read_text()).settings == settings


def test_publishing_replaces_the_figures_that_were_there(tmp_path: Path) -> None:
    publish_results(TOY, page, {"success": b"1", "gap": b"2"}, tmp_path / "new")
    (tmp_path / "new/other_success.png").write_bytes(b"3")
    (tmp_path / "new/toy_mine.png").write_bytes(b"4")
    assert published_figures(tmp_path / "new", "toy") == {"success": b"1", "gap": b"2"}
    publish_results(TOY, page, {"data_efficiency": b"5"}, tmp_path / "new")
    assert published_figures(tmp_path / "new", "toy") == {"data_efficiency": b"5"}
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        *("other_success.png", "toy.json", "toy.md", "toy_data_efficiency.png", "toy_mine.png")
    ]
    text = (tmp_path / "new/toy.md").read_text()
    assert text == "figures: {'data_efficiency': 'toy_data_efficiency.png'}"


def test_rows_and_seeds_that_are_published_are_not_lost(tmp_path: Path) -> None:
    check_none_lost(TOY, tmp_path)
    publish_results(TOY, page, {}, tmp_path)
    check_none_lost(TOY, tmp_path)
    check_none_lost(bare_results("toy", {"astra": [0, 1, 2], "nas": [0]}, {"x": [1.5, 2.0]}), tmp_path)
    check_none_lost(bare_results("other", {"nas": [0]}, {"x": [1.5]}), tmp_path)
    with pytest.raises(BadInputError, match=r"toy.json: .* got none for astra of seed 0: use --add"):
        check_none_lost(bare_results("toy", {"astra": [1, 2]}, {"x": [1.5, 2.0]}), tmp_path)
    with pytest.raises(BadInputError, match="got none for astra of seed 0, astra of seed 1: use --add"):
        check_none_lost(bare_results("toy", {"nas": [0, 1]}, {"x": [1.5, 2.0]}), tmp_path)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "toy.json"
    with pytest.raises(BadInputError, match=r"expected published results in .*toy.json, found none"):
        read_published(path)
    path.write_text("{}")
    with pytest.raises(BadInputError, match=r"toy.json does not hold results in the current format"):
        read_published(path)
