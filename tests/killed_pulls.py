"""Pull a dataset and be killed at random moments: killed_pulls.py SOURCE OUT TRUTH KILLS.

After each kill, OUT is either absent or bit-identical to TRUTH. Prints how often it was which.
"""

import random
import shutil
import signal
import sys
import time
from pathlib import Path

import fsspec.implementations.local  # noqa: F401 - here, so that no child spends its life on it
from forks import forked
from shared_files import contents

from astra_data.dataset.reader import Dataset
from astra_data.io.hub import stores
from astra_data.io.hub.sharing import pull

stores.BLOCK_BYTES = 1024


def check(out: Path, truth: Path) -> None:
    assert Dataset.open(out).verify() == [] and contents(out) == contents(truth)


def main(source: str, out: Path, truth: Path, kills: int) -> None:
    assert not out.exists()
    began = time.perf_counter()
    assert forked(lambda: pull(source, out=out)) == 0
    longest = time.perf_counter() - began
    shutil.rmtree(out)
    rng = random.Random(0)
    finished = resumed = 0
    for _ in range(kills):
        assert forked(lambda: pull(source, out=out), rng.uniform(0, 1.3 * longest)) in (0, -signal.SIGKILL)
        resumed += any(out.parent.glob(f".{out.name}.pull-*/*"))
        if out.exists():
            finished += 1
            assert forked(lambda: check(out, truth)) == 0
            shutil.rmtree(out)
    assert forked(lambda: pull(source, out=out)) == 0 and forked(lambda: check(out, truth)) == 0
    assert [path.name for path in out.parent.iterdir() if path.name.startswith(".")] == []
    print(f"{kills} kills: {resumed} left a part, {finished} a whole dataset, {longest:.2f} s a pull")
    print("whole")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
