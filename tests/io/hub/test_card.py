import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, concatenated, fake_episodes, write_fake
from huggingface_hub import DatasetCard

from astra_data.core.config import load_recipe
from astra_data.dataset.columns import ACTION, NEXT_STATE, OUTCOME_COLUMNS, STATE, SUCCESS, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.card import Notes, render_card, write_card
from astra_data.robots.registry import TASKS

NOTES = Notes(license="mit", summary="A sum.", behavior="It walks.", intended_use="For tests.", limits="Nothing real.")


def test_the_card_tells_all_that_the_dataset_knows(tmp_path: Path) -> None:
    parent = {"name": "mother", "version": "2.1.0", "hash": "ab" * 32}
    simulator = {"id": "point_mass", "radius_m": 0.1}
    description = {**DESCRIPTION, "parents": [parent], "simulator": simulator}
    dataset = write_fake(tmp_path / "fake", description=description)
    text = render_card(dataset, NOTES)
    told = [
        *("license: mit", "- LeRobot", "- robotics", "data_files: data/*/*.parquet"),
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


def test_long_names_stand_below_the_table_and_facts_are_of_the_episodes_that_have_them(tmp_path: Path) -> None:
    joints = tuple("abcde")
    columns = [Column("near", size=5, names=joints), Column("far", size=5, names=joints)]
    columns += [Column("few", size=4, names=joints[:4]), Column(SUCCESS, "bool")]
    values = {column.name: np.zeros((500, column.size), np.float32) for column in columns[:3]}
    told = enumerate(({"return": 1.0}, {"return": 3.0}, dict[str, float]()))
    episodes = (Episode(uid, values | {SUCCESS: np.full(500, uid == 1)}, facts) for uid, facts in told)
    text = render_card(write_fake(tmp_path / "wide", episodes, columns=columns), Notes())
    assert "In `near` and `far`, in order: a, b, c, d, e." in text and text.count("in order") == 1
    assert "| `few` | float32 | (4,) |  | a, b, c, d |" in text
    assert "| return | mean 2.00; 1.00 to 3.00 |\n| success | 1 of 3 episodes (33.3%) |" in text


def test_sums_are_folded_away(fake: Dataset) -> None:
    text = render_card(fake, NOTES)
    shown, _, folded = text.partition("<details>")
    folded, _, after = folded.partition("</details>")
    assert fake.content_hash in folded and fake.content_hash not in shown + after
    # A table inside of HTML is read as one only after an empty line.
    assert "</summary>\n\n| what | value |" in folded and folded.endswith("|\n\n")


def test_without_its_figure_no_card_is_written(fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "astra_data.reports.figures.style", None)
    with pytest.raises(ModuleNotFoundError, match="style"):
        write_card(fake, tmp_path / "it.md", Notes())
    assert [*tmp_path.iterdir()] == []


def test_without_positions_there_is_no_figure(tmp_path: Path) -> None:
    actions = Episode(0, {ACTION: fake_episodes()[0].columns[ACTION]})
    plain = write_fake(tmp_path / "plain", [actions], columns=[COLUMNS[1]])
    assert write_card(plain, tmp_path / "it.md", Notes()) == [tmp_path / "it.md"]
    assert "![" not in (tmp_path / "it.md").read_text()


def test_what_strangers_wrote_is_words_in_a_card(tmp_path: Path) -> None:
    bad = "x\n# Heading\n<script>alert(1)</script> | y"
    columns = [Column(ACTION, size=2, names=("<b>", "y"), meaning=bad, astra={"unit": ["<i>", "m"]})]
    description = {**DESCRIPTION, "config": {bad: "`<script>"}, "stage": bad}
    episode = Episode(0, {ACTION: np.zeros((3, 2), np.float32)}, {bad: True})
    dataset = write_fake(tmp_path / "set", [episode], columns=columns, task=bad, description=description)
    text = re.sub(r"`[^`\n]*`", "", render_card(dataset, NOTES))
    assert "<script>" not in text and "<b>" not in text and "<i>" not in text
    assert not re.search("^# Heading", text, re.MULTILINE)


def test_the_code_that_it_shows_runs(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_fake(tmp_path / "datasets/fake/data-1.0.0")
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "datasets"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path / "cache")
    ours, _, theirs = python_blocks(render_card(Dataset.open(tmp_path / "datasets/fake/data-1.0.0"), Notes()))
    found: dict[str, Any] = {}
    exec(ours, found)
    np.testing.assert_array_equal(found["values"][STATE], concatenated(STATE))
    exec(theirs, found)
    np.testing.assert_array_equal(np.array(found["rows"][STATE], dtype=np.float32), concatenated(STATE))


def test_a_shared_dataset_is_loaded_from_where_it_is(fake: Dataset) -> None:
    on_hub = render_card(fake, Notes(), source="hf://datasets/me/it")
    assert "astra-data pull hf://datasets/me/it --version 1.0.0" in on_hub
    assert 'LeRobotDataset("me/it", revision="data-1.0.0")' in on_hub
    assert 'load_dataset("me/it", revision="data-1.0.0", split="train")' in on_hub
    elsewhere = render_card(fake, Notes(), source="s3://bucket/fake")
    assert "astra-data pull s3://bucket/fake --version 1.0.0" in elsewhere
    for text in (on_hub, elsewhere):
        for block in python_blocks(text):
            compile(block, "card", "exec")


def python_blocks(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


CARDS = sorted((Path(__file__).parents[3] / "dataset_cards").glob("*.md"))


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_a_card_has_its_columns_the_words_of_its_notes_and_its_figure(path: Path) -> None:
    card = DatasetCard.load(path)
    assert card.data.license == "apache-2.0" and "LeRobot" in card.data.tags
    assert f"# {path.stem}\n" in card.text
    task = TASKS.get(path.stem.removesuffix("-random-seed0"))
    names = [STATE, ACTION, NEXT_STATE]
    if task is not None:
        names = [column.name for column in (*task.state_columns, *OUTCOME_COLUMNS)]
    assert [name for name in names if f"`{name}`" not in card.text] == []
    notes = load_recipe(path.with_suffix(".toml"), Notes)
    text = path.read_text(encoding="utf-8")
    assert [words for words in notes.model_dump().values() if words.strip() not in text] == []
    figure = path.with_name(f"{path.stem}-coverage.png")
    if path.stem.startswith("fetch"):  # whose states have no positions by name
        assert not figure.exists() and figure.name not in text
        return
    assert f"]({figure.name})" in text and figure.read_bytes().startswith(b"\x89PNG")
