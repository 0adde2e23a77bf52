"""How far the points of a sweep are: a table that a terminal shows above the running items."""

import time
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping

from rich.table import Table

from astra_data.experiments.local_executor import Item
from astra_data.experiments.points import RunPoint
from astra_data.reports.figures import method_title
from astra_data.worlds.score import Score

DOING = {
    "collect": "collecting",
    "pair": "pairing",
    "subset": "cutting",
    "ground": "grounding",
    "train": "training",
    "align": "aligning",
    "evaluate": "evaluating",
}
"""What a point is at while a stage works for it."""


class Board:
    """The states of all points of a sweep: one per cell, or the seeds of a size in one.

    Args:
        points: in the order of the table.
        items: every artefact that they need, finished or not.
        score: what is told of a point that is finished.
        means: over the episodes of those that are.
        to_do: keys of the items that are not finished.
    """

    def __init__(
        self,
        points: Collection[RunPoint],
        items: Collection[Item],
        score: Score,
        means: Mapping[RunPoint, float],
        to_do: Collection[str],
    ) -> None:
        """Begin with nothing running."""
        by_key = {item.key: item for item in items}
        self._points = tuple(points)
        self._needs = {point: frozenset(needed(point.key, by_key)) for point in points}
        self._score, self._means = score, dict(means)
        self._to_do = set(to_do) - {"report"}
        self._running: dict[str, tuple[float, float]] = {}
        self._failed: set[str] = set()
        self._seconds: dict[str, list[float]] = defaultdict(list)
        self._began = time.monotonic()

    def started(self, key: str) -> None:
        """Note that an item has begun."""
        self._running[key] = (0.0, time.monotonic())

    def progressed(self, key: str, fraction: float) -> None:
        """Note how much of an item is done."""
        self._running[key] = (fraction, self._running[key][1])

    def finished(self, key: str, seconds: float) -> None:
        """Note that an item is finished."""
        del self._running[key]
        self._to_do.discard(key)
        self._seconds[key.partition("/")[0]].append(seconds)

    def failed(self, key: str) -> None:
        """Note that an item has failed, whether it had begun or not."""
        self._running.pop(key, None)
        self._failed.add(key)

    def done(self, point: RunPoint, mean: float) -> None:
        """Note the score of a point whose evaluation is finished."""
        self._means[point] = mean

    def state(self, point: RunPoint) -> str:
        """Say what the point is at, such as "training 43 %" or "done 0.72"."""
        if point in self._means:
            return f"done {self._score.text(self._means[point])}"
        if not self._failed.isdisjoint(self._needs[point]):
            return "failed"
        running = [key for key in self._running if key in self._needs[point]]
        if not running:
            return "waiting"
        stages = list(DOING)
        key = max(running, key=lambda key: stages.index(key.partition("/")[0]))
        fraction, _ = self._running[key]
        return f"{DOING[key.partition('/')[0]]} {fraction:.0%}".replace("%", " %")

    def whole(self) -> str:
        """Say how many points are done, and how long the others may take."""
        left = self._seconds_left()
        when = "" if left is None else f", {_duration(left)} left"
        return f"{len(self._means)} of {len(self._points)} points{when}"

    def __rich__(self) -> Table:
        """Draw methods by sizes, or by seeds where there are no sizes."""
        sizes = list(dict.fromkeys(point.percent for point in self._points))
        columns: dict[str, list[RunPoint]] = defaultdict(list)
        for point in self._points:
            alone = len(sizes) == 1
            columns[f"seed {point.seed}" if alone else f"{point.percent} %"].append(point)
        table = Table(title=self.whole(), title_justify="left")
        table.add_column("method")
        for column in columns:
            table.add_column(column, justify="right")
        for method in dict.fromkeys(point.method for point in self._points):
            rows = [[point for point in cell if point.method == method] for cell in columns.values()]
            table.add_row(method_title(method), *map(self._cell, rows))
        return table

    def _cell(self, points: list[RunPoint]) -> str:
        """Return the state of a point; of several, how many are done, their mean and what one is at."""
        states = [self.state(point) for point in points]
        if len(points) == 1:
            return states[0]
        means = [self._means[point] for point in points if point in self._means]
        lines = [f"{len(means)} of {len(points)} done"]
        if means:
            lines[0] += f" {self._score.text(sum(means) / len(means))}"
        lines += [state for state in states if not state.startswith(("done", "waiting"))][:1]
        return "\n".join(lines)

    def _seconds_left(self) -> float | None:
        """Return the work that is left at the speed so far; None while a stage's duration is unknown."""
        now = time.monotonic()
        typical = {stage: sum(taken) / len(taken) for stage, taken in self._seconds.items()}
        done, left = sum(map(sum, self._seconds.values())), 0.0
        for key, (fraction, began) in self._running.items():
            done += now - began
            if fraction > 0:
                typical.setdefault(key.partition("/")[0], (now - began) / fraction)
        for key in self._to_do:
            stage = key.partition("/")[0]
            if stage not in typical:
                return None
            fraction, _ = self._running.get(key, (0.0, now))
            left += (1 - fraction) * typical[stage]
        return left * (now - self._began) / done if done else None


def needed(key: str, items: Mapping[str, Item]) -> Iterator[str]:
    """Yield `key` and the keys of all artefacts that it is made of.

    An evaluation is made of the policy and its encoder: the simulators that it tests them in are none of it.
    """
    yield key
    for read in items[key].inputs:
        if not (key.startswith("evaluate/") and read.startswith("ground/")):
            yield from needed(read, items)


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
