"""Run commands as a person types them, each in a fork of a process that has loaded nothing that takes seconds.

Reads [[argument, ...], ...] from the standard input, and prints [[exit code, output, [large package, ...]], ...] of
`astra-data ARGUMENT ...`: what each prints, and which large packages it loads.
"""

import importlib
import json
import sys
from functools import partial

from forks import shown

from astra_data.cli.app import main

LARGE = ("torch", "mujoco", "gymnasium", "scipy", "pandas", "matplotlib", "lerobot", "datasets")
MARK = "loaded: "


def run(arguments: list[str]) -> None:
    sys.argv = ["astra-data", *arguments]
    try:
        main()
    finally:
        sys.stderr.flush()
        print(MARK, *(name for name in LARGE if name in sys.modules))


def result(arguments: list[str]) -> tuple[int, str, list[str]]:
    code, output = shown(partial(run, arguments))
    told, _, loaded = output.rpartition(MARK)
    return code, told, loaded.split()


if __name__ == "__main__":
    importlib.import_module("astra_data.pipeline.run")  # what all commands on recipes load
    print(json.dumps([result(arguments) for arguments in json.load(sys.stdin)]))
