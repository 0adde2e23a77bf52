"""Run commands of this environment, each in a fork of a process that has loaded what takes seconds.

Reads from the standard input {"modules": [...], "commands": {name: [command, argument, ...]}}, and prints
{name: [exit code, output]}.
"""

import importlib
import json
import runpy
import sys
from functools import partial
from pathlib import Path

from forks import shown

BIN = Path(sys.executable).parent


def run(command: list[str]) -> None:
    sys.argv = [str(BIN / command[0]), *command[1:]]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    for module in asked["modules"]:
        importlib.import_module(module)
    print(json.dumps({name: shown(partial(run, command)) for name, command in asked["commands"].items()}))
