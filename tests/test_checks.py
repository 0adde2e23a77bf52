"""What is checked before a change is taken is the same, and told the same, everywhere."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = "pip install uv && uv run pytest"


def commands() -> list[str]:
    lines = map(str.strip, (ROOT / ".ci" / "run").read_text().splitlines())
    return [line for line in lines if line.startswith("uv run")]


def test_the_tests_are_called_as_the_readme_says() -> None:
    for page in (".ci/run", "README.md", "CONTRIBUTING.md"):
        assert TESTS in (ROOT / page).read_text().splitlines()


def test_contributors_are_told_every_check() -> None:
    told = re.findall(r"^uv run .+$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert told[: len(commands()) + 1] == [*commands(), "uv run pytest"]


def test_hooks_run_every_check_before_a_commit() -> None:
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    assert re.findall(r"^ +entry: (.+)$", hooks, re.MULTILINE) == commands()
