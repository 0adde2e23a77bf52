"""Check the forecasts of a diagnosis by really adding the recordings.

    uv run python tools/check_forecasts.py DATASET SIMULATOR

DATASET is paired with SIMULATOR and has many recordings. Forecasts are made of 10, 20, 40 and 80 of them, ten random
ones each, and compared with the error that is left when half as many again are added, on the last fifth.
"""

import sys
from dataclasses import replace

import numpy as np

from astra_data.dataset.versions import open_dataset
from astra_data.grounding import diagnosis
from astra_data.robots.registry import pairing_named


def main(dataset: str, simulator: str) -> None:
    """Print a line for each number of recordings."""
    source, pairing = open_dataset(dataset), pairing_named(simulator)
    log = diagnosis._Log.of(source)
    every = diagnosis._Error.of(log, diagnosis._Felt.of(log, pairing, source.info["fps"]))
    count, rng = int(every.recording.max()) + 1, np.random.default_rng(1)
    print(f"{source.reference}: {count} recordings are long enough")

    for size in (10, 20, 40, 80):
        if 1.5 * size > 0.8 * count:
            return
        forecasts, actual, before = [], [], []
        for _ in range(10):
            order = rng.permutation(count)
            rows = np.isin(every.recording, order[:size])
            some = replace(
                every,
                rows=every.rows[rows],
                error=every.error[rows][:, varies := every.error[rows].std(axis=0) > 0],
                recording=np.unique(every.recording[rows], return_inverse=True)[1],
                present=every.present[rows],
                commands=every.commands[varies][:, rows],
                past=every.past[rows],
            )
            forecasts.append(diagnosis._forecast(some))
            tested = order[int(0.8 * count) :]
            actual.append(every.share_left(order[: forecasts[-1].more], tested))
            before.append(every.share_left(order[:size], tested))
        ends = [one.expected for one in forecasts]
        inside = sum(low <= value <= high for (_, low, high), value in zip(ends, actual, strict=True))
        apart = [abs(value - then) / value for (then, _, _), value in zip(ends, actual, strict=True)]
        print(
            f"{size}: {np.median(before):.3f} are left; with half as many again forecast "
            f"{np.median([then for then, _, _ in ends]):.3f}, measured {np.median(actual):.3f}; "
            f"apart by {100 * np.median(apart):.0f} % (median), {inside} of 10 within the forecast's interval"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
