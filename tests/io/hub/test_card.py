import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, fake_episodes, write_fake, writer
from huggingface_hub import DatasetCard

from astra_data.core.config import load_recipe
from astra_data.core.errors import BadInputError, DiskError, RecipeError
from astra_data.dataset.columns import ACTION, STATE, SUCCESS, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.card import _size_category, render_card, write_card
from astra_data.io.hub.notes import Notes

NOTES = Notes(
    license="mit", summary="A sum.", behavior="It walks.", intended_use="For tests.", limits="Nothing real."
)


def test_the_front_matter_says_what_the_hub_reads(fake: Dataset, tmp_path: Path) -> None:
    write_card(fake, tmp_path / "it.md", NOTES)
    data = DatasetCard.load(tmp_path / "it.md").data.to_dict()
    assert data["license"] == "mit"
    assert data["task_categories"] == ["robotics"]
    assert "LeRobot" in data["tags"]
    assert data["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    assert data["size_categories"] == ["n<1K"]


def test_the_card_tells_all_that_the_dataset_knows(tmp_path: Path) -> None:
    parent = {"name": "mother", "version": "2.1.0", "hash": "ab" * 32}
    simulator = {"id": "point_mass", "radius_m": 0.1}
    description = {**DESCRIPTION, "parents": [parent], "simulator": simulator}
    dataset = write_fake(tmp_path / "fake", description=description)
    text = render_card(dataset, NOTES)
    told = [
        *("# fake\n", "A sum.", "It walks.", "For tests.", "Nothing real.", "“run”", "20 Hz", "5 episodes"),
        *("mother@data-2.1.0", "ab" * 32, '"noise_m": 0.1', '"collect": 0', "Fake-v0", "point_mass"),
        *(dataset.content_hash, "| made by stage | collect |", dataset.description["packages"]["mujoco"]),
        *(
            "2 of 5 episodes (40.0%)",
            "1 to 30 steps; quartiles 5, 7, 12",
            "| steps | 55 |",
            "| duration | 0.0 min |",
            "Deng",
            "x, y, yaw",
        ),
        f"| `{STATE}` | float32 | (3,) | m (2), rad | pose: x, y, yaw |",
        f"| `{ACTION}` | float32 | (2,) |  | x, y |",
    ]
    assert [words for words in told if words not in text] == []
    assert [name for name in dataset.features if f"`{name}`" not in text] == []
    assert str(dataset.description["git_commit"]) in text


def test_the_card_says_that_a_robot_is_a_stand_in(fake: Dataset, tmp_path: Path) -> None:
    assert "stand-in" not in render_card(fake, NOTES)
    description = {**DESCRIPTION, "environment": {"id": "naö", "stand_in": "surrogate"}}
    text = render_card(write_fake(tmp_path / "fake", description=description), NOTES)
    assert "The robot is a simulated stand-in (`surrogate`) for a physical one." in text
    assert '"naö"' in text and "| from | nothing earlier |" in text


def test_long_names_stand_below_the_table_and_facts_are_of_the_episodes_that_have_them(
    tmp_path: Path,
) -> None:
    joints = tuple("abcde")
    columns = [Column("near", size=5, names=joints), Column("far", size=5, names=joints)]
    columns += [Column("few", size=4, names=joints[:4]), Column(SUCCESS, "bool")]
    with writer(tmp_path / "wide", columns=columns) as out:
        for uid, facts in enumerate(({"return": 1.0}, {"return": 3.0}, {})):
            values = {column.name: np.zeros((500, column.size), np.float32) for column in columns[:3]}
            out.add(Episode(uid, values | {SUCCESS: np.full(500, uid == 1)}, facts))
    text = render_card(Dataset.open(tmp_path / "wide"), Notes())
    assert "In `near` and `far`, in order: a, b, c, d, e." in text and text.count("in order") == 1
    assert "| `few` | float32 | (4,) |  | a, b, c, d |" in text
    assert "| return | mean 2.00; 1.00 to 3.00 |\n| success | 1 of 3 episodes (33.3%) |" in text
    assert "- 1K<n<10K\n" in text


def test_sizes_are_the_hubs() -> None:
    """As size_categories.json of the package datasets lists them."""
    units = ["1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B", "100B", "1T"]
    listed = ["n<1K", *(f"{least}<n<{most}" for least, most in pairwise(units)), "n>1T"]
    bounds = [10**power for power in range(3, 13)]
    assert [_size_category(steps) for steps in (1, *bounds)] == listed
    assert [_size_category(steps - 1) for steps in bounds] == listed[:-1]


def test_without_notes_their_sections_are_left_out(fake: Dataset) -> None:
    text = render_card(fake, Notes())
    assert "license: unknown" in text
    assert re.findall(r"^## (.*)", text, re.MULTILINE) == [
        *("Loading", "Contents", "Columns", "Provenance", "Citation")
    ]


def test_words_cannot_break_a_table(tmp_path: Path) -> None:
    meaning = "left | right,\nor none"
    with writer(tmp_path / "odd", columns=[Column("odd", meaning=meaning)]) as out:
        out.add(Episode(0, {"odd": np.zeros(1, dtype=np.float32)}))
    assert "| left \\| right, or none |" in render_card(Dataset.open(tmp_path / "odd"), Notes())


def test_the_figure_is_shown(fake: Dataset, tmp_path: Path) -> None:
    card, figure = write_card(fake, tmp_path / "it.md", Notes())
    assert figure.read_bytes().startswith(b"\x89PNG")
    text = card.read_text()
    assert text.index(f"]({figure.name})") < text.index("## Loading") < text.index("## Contents")


def test_what_a_person_wrote_is_not_replaced(fake: Dataset, tmp_path: Path) -> None:
    files = write_card(fake, tmp_path / "it.md", NOTES)
    assert write_card(fake, tmp_path / "it.md", NOTES) == files
    with files[0].open("a") as card:
        card.write("Robot 3 has a loose wheel.\n")
    with pytest.raises(BadInputError, match=r"it\.md exists already and is not this card; delete it or"):
        write_card(fake, tmp_path / "it.md", NOTES)
    assert files[0].read_text().endswith("wheel.\n")


def test_sums_are_folded_away(fake: Dataset) -> None:
    text = render_card(fake, NOTES)
    shown, _, folded = text.partition("<details>")
    folded, _, after = folded.partition("</details>")
    assert fake.content_hash in folded and fake.content_hash not in shown + after
    # A table inside of HTML is read as one only after an empty line.
    assert "</summary>\n\n| what | value |" in folded and folded.endswith("|\n\n")


def test_without_positions_there_is_no_figure(tmp_path: Path) -> None:
    with writer(tmp_path / "plain", columns=[COLUMNS[1]]) as out:
        out.add(Episode(0, {ACTION: fake_episodes()[0].columns[ACTION]}))
    assert write_card(Dataset.open(tmp_path / "plain"), tmp_path / "it.md", Notes()) == [tmp_path / "it.md"]
    assert "![" not in (tmp_path / "it.md").read_text()


def test_notes_with_faults_are_told(tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text('limit = "none"\nlicense = 3\n')
    with pytest.raises(RecipeError, match=r"(?s)2 errors.*did you mean 'limits'"):
        load_recipe(tmp_path / "notes.toml", Notes)


def test_a_card_that_cannot_be_written_is_told(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / "none").touch()
    with pytest.raises(DiskError, match=r"it\.md cannot be written"):
        write_card(fake, tmp_path / "none/it.md", Notes())


def test_what_strangers_wrote_is_words_in_a_card(tmp_path: Path) -> None:
    bad = "x\n# Heading\n<script>alert(1)</script>"
    columns = [Column(ACTION, size=2, names=("<b>", "y"), meaning=bad, astra={"unit": ["<i>", "m"]})]
    description = {**DESCRIPTION, "config": {bad: "`<script>"}, "stage": bad}
    with writer(tmp_path / "set", columns=columns, task=bad, description=description) as open_writer:
        episode = Episode(0, {ACTION: np.zeros((3, 2), np.float32)}, {bad: True})
        open_writer.add(episode)
    text = re.sub(r"`[^`\n]*`", "", render_card(Dataset.open(tmp_path / "set"), NOTES))
    assert "<script>" not in text and "<b>" not in text and "<i>" not in text
    assert not re.search("^# Heading", text, re.MULTILINE)
