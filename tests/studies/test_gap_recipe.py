import pytest
from pydantic import ValidationError

from astra_data.studies.gap_recipe import GapRecipe


def recipe(**changes: object) -> GapRecipe:
    return GapRecipe.model_validate({"mapping": "m.toml", "models": ("gains",), "seeds": (3, 4)} | changes)


def test_the_raw_simulator_is_always_there_and_each_model_once() -> None:
    assert recipe(models=("gains", "ridge", "gains")).models == ("raw", "gains", "ridge")
    with pytest.raises(ValidationError, match="unknown model 'gain': did you mean 'gains'"):
        recipe(models=("gain",))


@pytest.mark.parametrize("key", ["seeds", "minutes"])
def test_a_seed_or_a_size_that_is_there_twice_is_not_counted_twice(key: str) -> None:
    with pytest.raises(ValidationError, match=rf"{key}\n.*expected each once, got \[3"):
        recipe(**{key: (3, 4, 3)})
