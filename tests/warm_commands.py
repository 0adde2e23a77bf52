"""Run commands of this environment, each in a fork of a process that has loaded what takes seconds.

Reads from the standard input {"modules": [...], "commands": {name: [command, argument, ...]}}, and prints
{name: [exit code, output]}.
"""

import importlib
import json
import os
import runpy
import sys
import tempfile
import traceback
from pathlib import Path
from typing import IO, Never

BIN = Path(sys.executable).parent


def run_in_fork(command: list[str]) -> tuple[int, str]:
    with tempfile.TemporaryFile("w+") as shown:
        child = os.fork()
        if child == 0:
            _become(command, shown)
        _, status = os.waitpid(child, 0)
        shown.seek(0)
        return os.waitstatus_to_exitcode(status), shown.read()


def _become(command: list[str], shown: IO[str]) -> Never:
    for stream in (1, 2):
        os.dup2(shown.fileno(), stream)
    code: object = 1
    try:
        sys.argv = [str(BIN / command[0]), *command[1:]]
        runpy.run_path(sys.argv[0], run_name="__main__")
        code = 0
    except SystemExit as asked:
        code = asked.code or 0
    finally:
        if sys.exception() is not None:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    for module in asked["modules"]:
        importlib.import_module(module)
    print(json.dumps({name: run_in_fork(command) for name, command in asked["commands"].items()}))
