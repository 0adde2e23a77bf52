import pytest

from astra_data.core.config import validated
from astra_data.pipeline.changed_settings import differences
from astra_data.pipeline.recipe import Recipe

RECIPE = {"task": "antmaze-umaze", "methods": ["direct_transfer"], "seeds": [0]}


def recipe(**changes: object) -> Recipe:
    return validated(RECIPE | changes, Recipe, "r.toml")


@pytest.mark.parametrize(
    ("before", "now", "told"),
    [
        ({}, {}, {}),
        ({}, {"methods": ["nas"], "seeds": [0, 1]}, {}),
        ({}, {"collect": {"episodes": 200}}, {}),  # the default
        ({}, {"collect": {"episodes": 60}}, {"collect": "episodes: 200, now 60"}),
        (
            {"train": {"discount": 0.9, "learning_rate": 0.1}},
            {"train": {"hidden_sizes": [8, 8], "tries": 4}},
            {
                "train": "learning_rate: 0.1, now 0.0005, discount: 0.9, now 0.99, "
                "hidden_sizes: [64, 64], now [8, 8] and 1 more"
            },
        ),
        ({}, {"task": "antmaze-long"}, {"task": '"antmaze-umaze", now "antmaze-long"'}),
        (
            {},
            {"report": {"trajectory_methods": ["nas"] * 20}},
            {"report": f'trajectory_methods: [], now [{'"nas", ' * 8}"na…'},
        ),
        ({"sweep": {"percent": [50, 100]}}, {"sweep": {"percent": [25, 100]}}, {}),
        ({"sweep": {"percent": [50]}}, {}, {"sweep": "50, now 100"}),
    ],
)
def test_what_changed_is_told_key_by_key(
    before: dict[str, object], now: dict[str, object], told: dict[str, str]
) -> None:
    assert differences(recipe(**before).settings, recipe(**now)) == told


def test_another_simulator_of_the_same_target_is_no_other_task() -> None:
    before, now = (
        recipe(task=f"humanoid-{simulator}", collect={"start": "task"})
        for simulator in ("walker2d", "extended")
    )
    assert [*differences(before.settings, now)] == ["simulator"]
