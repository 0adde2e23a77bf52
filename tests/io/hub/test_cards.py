import re
from pathlib import Path

import pytest
from huggingface_hub import DatasetCard

from astra_data.core.config import load_recipe
from astra_data.dataset.columns import ACTION, NEXT_STATE, OUTCOME_COLUMNS, STATE
from astra_data.io.hub.notes import Notes
from astra_data.robots.registry import TASKS

CARDS = sorted((Path(__file__).parents[3] / "dataset_cards").glob("*.md"))


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_a_card_says_what_the_hub_reads_and_names_every_column(path: Path) -> None:
    card = DatasetCard.load(path)
    assert card.data.license == "apache-2.0"
    assert "LeRobot" in card.data.tags
    assert f"# {path.stem}\n" in card.text
    task = TASKS.get(path.stem.removesuffix("-random-seed0"))
    names = [STATE, ACTION, NEXT_STATE]
    if task is not None:
        names = [column.name for column in (*task.state_columns, *OUTCOME_COLUMNS)]
    assert [name for name in names if f"`{name}`" not in card.text] == []


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_a_card_has_the_words_of_its_notes_and_its_figure(path: Path) -> None:
    notes = load_recipe(path.with_suffix(".toml"), Notes)
    text = path.read_text(encoding="utf-8")
    assert [words for words in notes.model_dump().values() if words.strip() not in text] == []
    figure = path.with_name(f"{path.stem}-coverage.png")
    if path.stem.startswith("fetch"):  # whose states have no positions by name
        assert not figure.exists() and figure.name not in text
        return
    assert f"]({figure.name})" in text
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_a_card_begins_with_what_a_person_wants_and_folds_sums_away(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert titles[:2] == ["Loading", "Behavior"]
    assert titles[-3:] == ["Columns", "Provenance", "Citation"]
    if "![" in text:
        assert text.index("![") < text.index("## Loading")
    shown = re.sub(r"<details>.*?</details>", "", text, flags=re.DOTALL)
    assert re.search(r"[0-9a-f]{40}", text) and not re.search(r"[0-9a-f]{40}", shown)
