from pathlib import Path

import pytest
from huggingface_hub import DatasetCard

from astra_data.columns import OUTCOME_COLUMNS
from astra_data.tasks import TASKS

CARDS = sorted((Path(__file__).parents[1] / "dataset_cards").glob("*.md"))


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_a_card_says_what_the_hub_reads_and_names_every_column(path: Path) -> None:
    card = DatasetCard.load(path)
    assert card.data.license == "apache-2.0"
    assert "LeRobot" in card.data.tags
    assert f"# {path.stem}\n" in card.text
    task = TASKS[path.stem.removesuffix("-random")]
    names = [column.name for column in (*task.state_columns, *OUTCOME_COLUMNS)]
    assert [name for name in names if f"`{name}`" not in card.text] == []
