from math import sqrt
from pathlib import Path

import pytest

from astra_data.reports.eval_info import eval_info
from astra_data.reports.files import read_published
from astra_data.reports.schema import Results

PUBLISHED = Path(__file__).parents[2] / "recipes" / "results"


def published(name: str) -> Results:
    found = read_published(PUBLISHED / f"{name}.json")
    assert isinstance(found, Results)
    return found


def wilson(successes: int, count: int) -> list[float]:
    """Return the ends of the 95 % interval in percent, by the formula of Wilson (1927)."""
    z, share = 1.959963984540054, successes / count
    middle = share + z**2 / (2 * count)
    half = z * sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return [100 * (middle + sign * half) / (1 + z**2 / count) for sign in (-1, 1)]


def test_episodes_are_counted_by_row_and_by_seed() -> None:
    results = published("antmaze_long_fresh")
    results = results.model_copy(update={"methods": {"nas": results.methods["nas"]}})
    row = results.methods["nas"].model_copy(
        update={"seeds": [7, 9], "success": [0.29, 0.58], "returns": [1.0, 4.0], "steps": [10.0, 20.0]}
    )
    info = eval_info(results.model_copy(update={"methods": {"nas": row}}))
    assert info["per_group"] == {
        "nas": {
            "n_episodes": 200,
            "n_success": 87,
            "pc_success": 43.5,
            "pc_success_ci95": pytest.approx(wilson(87, 200)),
            "avg_sum_reward": 2.5,
        }
    }
    first, second = info["per_task"]
    assert (first["task_group"], first["task_id"], second["task_id"]) == ("nas", 7, 9)
    assert second["metrics"] == {
        "n_episodes": 100,
        "n_success": 58,
        "pc_success": 58.0,
        "pc_success_ci95": pytest.approx(wilson(58, 100)),
        "avg_sum_reward": 4.0,
        "avg_episode_steps": 20.0,
    }


def test_where_they_come_from_is_said() -> None:
    results = published("antmaze_long_fresh")
    told = eval_info(results)["provenance"]
    assert told["made_by"] == results.command and told["env"] == "antmaze-long"
    assert told["datasets"][0]["hashes"] == results.evaluated_with[0].hashes
    assert told["origins"][0]["commit"] == results.origins[0].commit
