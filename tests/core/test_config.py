from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field, ValidationError

from astra_data.core.config import Config, faults_of, load_recipe, own_settings, validated
from astra_data.core.errors import BadInputError, RecipeError


class Training(Config):
    env_steps: int = Field(default=10, gt=0)
    learning_rate: float = 1e-3
    """Of Adam."""
    hidden_sizes: tuple[int, ...] = (4, 4)
    learner: Literal["ppo", "sac"] = "ppo"
    note: str = Field(default="none", min_length=2)


class Experiment(Config):
    task: str
    seeds: tuple[int, ...] = (0,)
    train: Training = Training()


def write(folder: Path, text: str) -> Path:
    path = folder / "recipe.toml"
    path.write_text(text)
    return path


def fault(folder: Path, text: str) -> str:
    path = write(folder, text)
    with pytest.raises(RecipeError) as caught:
        load_recipe(path, Experiment)
    return str(caught.value).replace(str(path), "FILE")


def test_a_recipe_is_read_into_its_model(tmp_path: Path) -> None:
    text = 'task = "maze"\nseeds = [3, 4]\n[train]\nlearning_rate = 1\nhidden_sizes = [8]\n'
    recipe = load_recipe(write(tmp_path, text), Experiment)
    training = Training(learning_rate=1.0, hidden_sizes=(8,))
    assert recipe == Experiment(task="maze", seeds=(3, 4), train=training)
    assert isinstance(recipe.train.learning_rate, float)


def test_configs_are_frozen_and_described_by_the_strings_under_their_fields() -> None:
    with pytest.raises(ValidationError):
        Training().env_steps = 3
    assert Training.model_fields["learning_rate"].description == "Of Adam."


def test_all_faults_come_in_one_message(tmp_path: Path) -> None:
    text = 'seeds = [0, "one"]\n[train]\nlearning_rate = true\nlearner = "dqn"\nenvsteps = 1\n'
    assert fault(tmp_path, text).splitlines() == [
        "FILE has 5 errors:",
        "  task: expected a value, but the key is missing",
        "  seeds.1: expected a whole number, got 'one'",
        "  train.learning_rate: expected a number, got True",
        "  train.learner: expected 'ppo' or 'sac', got 'dqn'",
        "  train.envsteps: unknown key: did you mean 'env_steps'?",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('tsk = "maze"', "tsk: unknown key: did you mean 'task'?"),
        ("learning_rates = 1.0", "learning_rates: unknown key: did you mean 'train.learning_rate'?"),
        ("[trian]", "trian: unknown key: did you mean 'train'?"),
        ("[train]\ncolor = 1", "train.color: unknown key; known: env_steps, learning_rate, hidden_sizes,"),
        ("[train]\nenv_steps = 1.5", "train.env_steps: expected a whole number, got 1.5"),
        ("train = 3", "train: expected a table, got 3"),
        ("seeds = 3", "seeds: expected an array, got 3"),
        ("[train]\nenv_steps = 0", "train.env_steps: expected greater than 0, got 0"),
        ("[train]\nlearning_rate = nan", "train.learning_rate: expected a finite number, got nan"),
        ('[train]\nenv_steps = "10"', "train.env_steps: expected a whole number, got '10'"),
        ('[train]\nnote = "a"', "FILE: train.note: string should have at least 2 characters"),
        ("[train]\nseeds = [1]", "'seeds' belongs to no table: move it above the first [table]"),
    ],
)
def test_a_fault_names_its_key_and_what_was_expected(tmp_path: Path, text: str, expected: str) -> None:
    task = "" if "tsk" in text else 'task = "maze"\n'
    assert expected in fault(tmp_path, task + text)


def test_a_syntax_error_names_its_line(tmp_path: Path) -> None:
    assert fault(tmp_path, 'task = "maze"\nseeds = [1,\nx').startswith("FILE, line 3: not valid TOML: ")
    assert fault(tmp_path, "task =").startswith("FILE, line 1: not valid TOML: ")


def test_a_missing_or_unreadable_recipe_is_one_line(tmp_path: Path) -> None:
    write(tmp_path, "")
    with pytest.raises(RecipeError, match=r"recipes\.toml does not exist: did you mean '.*recipe\.toml'\?$"):
        load_recipe(tmp_path / "recipes.toml", Experiment)
    with pytest.raises(RecipeError, match="is a folder: expected a TOML file"):
        load_recipe(tmp_path, Experiment)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RecipeError, match="cannot be read as a text file"):
        load_recipe(tmp_path / "binary.toml", Experiment)


def test_a_component_takes_its_own_settings_or_the_usual_ones() -> None:
    class Other(Config):
        pass

    usual, given = Training(), Training(env_steps=3)
    assert own_settings(None, usual) is usual and own_settings(given, usual) is given
    with pytest.raises(BadInputError, match="expected settings of Training, got Other"):
        own_settings(Other(), usual)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = " + "[" * 5000 + "]" * 5000, "is nested too deeply"),
        ("x = " + "9" * 5000, "cannot be read as TOML: Exceeds the limit"),
        (".".join("a" * 20_000) + " = 1", "recipe.toml line 1: a key of more than 64 parts"),
        ("x = 1\n[" + " . ".join("a" * 65) + "]", "recipe.toml line 2: a key of more than 64 parts"),
        ("x = {" + "'a'.\t" * 64 + "a = 1}", "recipe.toml line 1: a key of more than 64 parts"),
    ],
)
def test_hostile_toml_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(RecipeError, match=told) as error:
        load_recipe(write(tmp_path, text), Experiment)
    assert "\n" not in str(error.value)


def test_of_a_file_that_nobody_wrote_by_hand_the_first_faults_are_told() -> None:
    class Made(Config):
        numbers: tuple[int, ...]

    def told(text: str) -> str:
        with pytest.raises(ValidationError) as caught:
            Made.model_validate_json(text)
        return faults_of(caught.value)

    assert told('{"numbers": [1, "two"]}') == "numbers.1: Input should be a valid integer"
    assert told("{").startswith("file: Invalid JSON")
    five = "; ".join(f"numbers.{place}: Input should be a valid integer" for place in range(5))
    assert told('{"numbers": ["a", "b", "c", "d", "e"]}') == five
    assert told('{"numbers": ["a", "b", "c", "d", "e", "f", "g"]}') == f"{five}; and 2 more"


class Part(Config):
    unit: str = ""


class Parts(Config):
    columns: dict[str, Part] = Field(default_factory=dict)
    fps: int = 1


def test_a_key_of_a_table_of_any_name_is_hinted_at_by_itself() -> None:
    for name in ("action", "unit"):
        with pytest.raises(RecipeError, match=rf"columns\.{name}\.units: unknown key: did you mean 'unit'\?"):
            validated({"columns": {name: {"units": "m"}}}, Parts, "it")
