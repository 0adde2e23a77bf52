import tomllib
from pathlib import Path

import pytest

from astra_data.core.errors import EXTRAS, BadInputError, in_short, optional

DISTRIBUTIONS = {
    "PIL": "pillow",
    "gymnasium_robotics": "gymnasium-robotics",
    "lerobot": "lerobot[dataset]",
    "minari": "minari[hdf5]",
    "mcap_protobuf": "mcap-protobuf-support",
    "mcap_ros2": "mcap-ros2-support",
    "rerun": "rerun-sdk",
}


def test_a_missing_package_is_one_error_that_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "nosuch", "mcap")
    with pytest.raises(BadInputError, match=r"^nosuch is needed but not installed: uv sync --extra mcap$"):
        optional("nosuch.inner")
    monkeypatch.setattr("astra_data.core.errors._ROOT", Path("nowhere"))
    packages = '"mcap-protobuf-support>=0.5" "mcap-ros2-support>=0.5" "mcap>=1.2"'
    with pytest.raises(BadInputError, match=f"not installed: pip install {packages}$"):
        optional("nosuch.inner")
    assert optional("json").loads("1") == 1


def test_every_package_is_in_the_extra_that_is_named() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    for package, extra in EXTRAS.items():
        wanted = project["optional-dependencies"][extra]
        assert any(entry.startswith(f"{DISTRIBUTIONS.get(package, package)}>=") for entry in wanted), package
        assert not any(entry.startswith(f"{package}>=") for entry in project["dependencies"])


def test_the_first_line_of_an_error_is_short_and_printable() -> None:
    shown = in_short(ValueError(f"Expected 2 columns, got 1: \x1b[2J\0{'x' * 5000}\nand more"))
    assert shown.startswith("Expected 2 columns, got 1: ") and shown.isprintable() and len(shown) < 400


@pytest.mark.parametrize("message", ["One two. Three", "One two\nthree", "One two.", "One two:\nthree. Four"])
def test_only_the_first_sentence_is_shown(message: str) -> None:
    assert in_short(ValueError(message)) == "One two"
