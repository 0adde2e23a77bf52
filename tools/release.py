"""Make a release: version and date in the files, every check, the wheel tried by itself, a commit and a tag.

From a clean checkout: `uv run python tools/release.py 0.2.0 https://github.com/OWNER/NAME`. It publishes
nothing, and ends with how to.
"""

import re
import subprocess
import tempfile
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
FILES = ("pyproject.toml", "CHANGELOG.md", "CITATION.cff")


def main(
    version: Annotated[str, typer.Argument(help="Such as 0.2.0, as in the changelog's heading.")],
    home: Annotated[str, typer.Argument(help="Address of the repository, to which links on the index lead.")],
) -> None:
    """Make release `version` of this checkout."""
    if _output("git", "status", "--porcelain"):
        raise typer.BadParameter("there are uncommitted changes: commit or stash them first")
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name in FILES}
    for name, text in released(texts, version, datetime.now(UTC).date()).items():
        (ROOT / name).write_text(text, encoding="utf-8")
    try:
        _output("uv", "lock")
        subprocess.run([ROOT / ".ci" / "run"], cwd=ROOT, check=True)
        readme = README.read_text(encoding="utf-8")
        README.write_text(on_index(readme, home, version), encoding="utf-8")
        _output("uv", "build", "--clear")
        README.write_text(readme, encoding="utf-8")
        _try_wheel(next((ROOT / "dist").glob("*.whl")))
    except BaseException as error:
        _output("git", "checkout", "--", ".")
        if not isinstance(error, subprocess.CalledProcessError):
            raise
        command = " ".join(map(str, error.cmd))
        print(f"not released, and the files are as before: {command} failed, as it says above")
        raise typer.Exit(1) from None
    _output("git", "commit", "--all", "--message", f"Release {version}")
    _output("git", "tag", "--annotate", f"v{version}", "--message", f"Release {version}")
    print(f"released {version} here; to the world: git push --follow-tags && uv publish")


def released(texts: dict[str, str], version: str, day: date) -> dict[str, str]:
    """Return the `FILES` with `version` and `day` in them.

    Raises:
        typer.BadParameter: `version` is no release, or not the one that these files lead to.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise typer.BadParameter(f"{version} is no release: expected three numbers, such as 0.2.0")
    changes = {
        "pyproject.toml": (f'version = "{version}.dev0"', f'version = "{version}"'),
        "CHANGELOG.md": (f"## [Unreleased] - {version}\n", f"## [{version}] - {day}\n"),
        "CITATION.cff": ("type: software\n", f"type: software\nversion: {version}\ndate-released: {day}\n"),
    }
    done = {}
    for name, (before, after) in changes.items():
        if texts[name].count(before) != 1:
            raise typer.BadParameter(f"{name} should hold this once: {before.strip()}")
        known = re.sub(r"^(version|date-released): .*\n", "", texts[name], flags=re.MULTILINE)
        done[name] = known.replace(before, after)
    return done


def on_index(readme: str, home: str, version: str) -> str:
    """Return `readme` with links and pictures of its own files that lead to those of `version` at `home`.

    The package index shows it away from these files.
    """

    def absolute(link: re.Match[str]) -> str:
        text, file = link.groups()
        kind = "raw" if text.startswith("!") else "blob"
        return f"{text}({home.rstrip('/')}/{kind}/v{version}/{file})"

    return re.sub(r"(!?\[[^]]*\])\((?![a-z]+:|#)([^)]+)\)", absolute, readme)


def _try_wheel(wheel: Path) -> None:
    """Run the quickstart from `wheel` in an empty folder and an environment of its own."""
    with tempfile.TemporaryDirectory() as folder:
        program = ["uvx", "--isolated", "--from", f"astra-data[all] @ {wheel.as_uri()}", "astra-data"]
        subprocess.run([*program, "recipes", "copy", "quickstart"], cwd=folder, check=True)
        subprocess.run([*program, "run", "recipes/quickstart.toml"], cwd=folder, check=True)


def _output(*words: str) -> str:
    return subprocess.run(words, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


if __name__ == "__main__":
    typer.run(main)
