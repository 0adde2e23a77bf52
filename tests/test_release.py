"""The script that makes a release."""

import tomllib
from datetime import date
from pathlib import Path

import pytest
import typer
from release import FILES, on_index, released

ROOT = Path(__file__).parents[1]
TEXTS = {
    "pyproject.toml": '[project]\nname = "it"\nversion = "0.3.0.dev0"\n',
    "CHANGELOG.md": "# Changelog\n\n## [Unreleased] - 0.3.0\n\nMuch.\n\n## [0.2.0] - 2026-01-02\n",
    "CITATION.cff": "title: it\ntype: software\nversion: 0.2.0\ndate-released: 2026-01-02\nlicense: MIT\n",
}


def test_version_and_day_are_written_once_everywhere() -> None:
    assert released(TEXTS, "0.3.0", date(2026, 12, 1)) == {
        "pyproject.toml": '[project]\nname = "it"\nversion = "0.3.0"\n',
        "CHANGELOG.md": "# Changelog\n\n## [0.3.0] - 2026-12-01\n\nMuch.\n\n## [0.2.0] - 2026-01-02\n",
        "CITATION.cff": ("title: it\ntype: software\nversion: 0.3.0\ndate-released: 2026-12-01\nlicense: MIT\n"),
    }


@pytest.mark.parametrize("version", ["v0.3.0", "0.4.0"])
def test_another_version_than_the_one_prepared_is_refused(version: str) -> None:
    with pytest.raises(typer.BadParameter, match=r"three numbers|pyproject\.toml should hold"):
        released(TEXTS, version, date(2026, 12, 1))


def test_a_changelog_that_does_not_lead_there_is_refused() -> None:
    texts = TEXTS | {"CHANGELOG.md": "# Changelog\n\n## [Unreleased]\n"}
    with pytest.raises(typer.BadParameter, match=r"CHANGELOG\.md should hold this once: ## \[Unreleased\] - 0\.3\.0"):
        released(texts, "0.3.0", date(2026, 12, 1))


def test_this_checkout_can_be_released_once() -> None:
    """Also while it is: the checks run with the version of the release in the files."""
    texts = {name: (ROOT / name).read_text() for name in FILES}
    current = tomllib.loads(texts["pyproject.toml"])["project"]["version"]
    version = current.removesuffix(".dev0")
    if version != current:
        texts = released(texts, version, date(2026, 12, 1))
    assert tomllib.loads(texts["pyproject.toml"])["project"]["version"] == version
    with pytest.raises(typer.BadParameter, match="should hold this once"):
        released(texts, version, date(2026, 12, 1))


def test_links_of_the_readme_lead_to_the_released_files() -> None:
    readme = "![A maze](maze.png), [a\nguide](docs/a.md#part), [elsewhere](https://example.org), [below](#end)"
    assert on_index(readme, "https://host.example/it/", "0.3.0") == (
        "![A maze](https://host.example/it/raw/v0.3.0/maze.png), "
        "[a\nguide](https://host.example/it/blob/v0.3.0/docs/a.md#part), "
        "[elsewhere](https://example.org), [below](#end)"
    )
