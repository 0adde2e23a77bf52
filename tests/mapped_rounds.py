"""Map columns into 40 caches one after another, as others do at the same time: mapped_rounds.py SET CACHES.

A process that lags behind finds files that are there already, and catches up with the one that writes.
"""

import sys
from pathlib import Path

import numpy as np

from astra_data.dataset.columns import ACTION, STATE
from astra_data.dataset.frames import mapped_columns
from astra_data.dataset.reader import Dataset

if __name__ == "__main__":
    dataset, caches = Dataset.open(Path(sys.argv[1])), Path(sys.argv[2])
    expected = dataset.columns([STATE, ACTION])
    for number in range(40):
        for name, values in mapped_columns(dataset, [STATE, ACTION], caches / str(number)).items():
            np.testing.assert_array_equal(values, expected[name])
