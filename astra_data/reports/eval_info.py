"""Results in the form of `lerobot-eval`'s eval_info.json, for tools that read those."""

from statistics import fmean
from typing import Any

from astra_data.reports.schema import Results
from astra_data.reports.statistics import share_interval


def eval_info(results: Results) -> dict[str, Any]:
    """Return successes by row and seed, and by row over its seeds; a row is a task group, a seed a task.

    `pc_success` is in percent, `pc_success_ci95` the ends of Wilson's interval for episodes alone, in
    percent: how much other seeds of a training would differ is in results.json.
    """
    return {
        "per_task": [
            {
                "task_group": name,
                "task_id": seed,
                "metrics": _counted([share], results.episodes)
                | {"avg_sum_reward": total, "avg_episode_steps": steps},
            }
            for name, row in results.methods.items()
            for seed, share, total, steps in zip(row.seeds, row.success, row.returns, row.steps, strict=True)
        ],
        "per_group": {
            name: _counted(row.success, results.episodes) | {"avg_sum_reward": fmean(row.returns)}
            for name, row in results.methods.items()
        },
        "provenance": {
            "made_by": results.command,
            "recipe": results.recipe,
            "env": results.task,
            "tested_in": results.tested_in,
            "datasets": [use.model_dump() for use in results.evaluated_with],
            "origins": [origin.model_dump() for origin in results.origins],
        },
    }


def _counted(shares: list[float], episodes: int) -> dict[str, Any]:
    """Return how many of the `episodes` of each share succeeded, all together."""
    count = episodes * len(shares)
    successes = sum(round(share * episodes) for share in shares)
    return {
        "n_episodes": count,
        "n_success": successes,
        "pc_success": 100 * successes / count,
        "pc_success_ci95": [100 * end for end in share_interval(successes, count)],
    }
