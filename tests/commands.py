"""Run commands of this environment, each in a fork of a process that has loaded `modules`, which take seconds.

Reads {"modules": [...], "commands": {name: [command, argument, ...]}} from the standard input, and prints
{name: [exit code, output, [large package, ...]]}: what each prints, and which large packages it loads.
"""

import importlib
import json
import runpy
import sys
from functools import partial
from pathlib import Path

from forks import shown

BIN = Path(sys.executable).parent
LARGE = ("torch", "mujoco", "gymnasium", "scipy", "pandas", "matplotlib", "lerobot", "datasets")
MARK = "loaded: "


def run(command: list[str]) -> None:
    sys.argv = [str(BIN / command[0]), *command[1:]]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    finally:
        sys.stderr.flush()
        print(MARK, *(name for name in LARGE if name in sys.modules))


def result(command: list[str]) -> tuple[int, str, list[str]]:
    code, output = shown(partial(run, command))
    told, _, loaded = output.rpartition(MARK)
    return code, told, loaded.split()


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    for module in asked["modules"]:
        importlib.import_module(module)
    print(json.dumps({name: result(command) for name, command in asked["commands"].items()}))
