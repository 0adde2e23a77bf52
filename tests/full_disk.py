"""Export in child processes whose files may only grow to a size; print how each ended, and its output."""

import json
import os
import resource
import sys

import h5py  # noqa: F401 - imported once, for all children
import minari.dataset.minari_dataset  # noqa: F401

from astra_data.cli.app import main
from astra_data.io import exporters  # noqa: F401 - while there is space

if __name__ == "__main__":
    dataset, folder, cases = sys.argv[1:]
    results = []
    for number, (format, name, limit) in enumerate(json.loads(cases)):
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os.dup2(writing, 1)
            os.dup2(writing, 2)
            os.close(writing)
            sys.argv[1:] = ["export", dataset, "--format", format, "--out", f"{folder}/{number}/{name}"]
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            # Ends as the command does: HDF5 closes what it holds.
            main()
            sys.exit()
        os.close(writing)
        with open(reading) as stream:
            output = stream.read()
        results.append((os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), output))
    print(json.dumps(results))
