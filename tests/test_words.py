"""The glossary and the words of CONTRIBUTING.md, enforced: one word for one thing, and words not used."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HOUSE = ROOT / "astra_data"
SECTION = (ROOT / "CONTRIBUTING.md").read_text().partition("\n## Words\n")[2].partition("\n## ")[0]
AVOIDED = SECTION.partition("| not | but |\n")[2]
WORDS = (ROOT / "docs/glossary.md").read_text().partition("\n## Letters in shapes")[0]
MODULES = {"base", "common", "helpers", "manager", "misc", "utils"}
"""Names of modules that say nothing."""
THEIRS = {"dts"}
"""Names of other packages': of a packet's decoding timestamp in PyAV."""


def rows(table: str) -> list[tuple[str, str]]:
    cells = re.findall(r"^\| (.+?) \| (.+) \|$", table, flags=re.MULTILINE)
    return [(word, meaning) for word, meaning in cells if word != "word"]


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of everything that a file names itself or asks others for."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.arg(arg=name) | ast.keyword(arg=str(name)) | ast.Name(id=name) | ast.Attribute(attr=name):
                yield node.lineno, name
            case ast.alias(name=name, asname=other):
                yield node.lineno, other or name.rpartition(".")[2]


@cache
def parts(name: str) -> tuple[str, ...]:
    """Return the words of an identifier: `doubt_penalty` and `DoubtPenalty` are "doubt", "penalty"."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name))


def holds(name: str, avoided: str) -> bool:
    """Tell whether consecutive words of `name` are those of `avoided`, in the singular or the plural."""
    given, wanted = parts(name), parts(avoided)
    forms = [{word, word.removesuffix("s"), f"{word}s"} for word in wanted]
    starts = range(len(given) - len(wanted) + 1)
    return any(all(given[start + i] in form for i, form in enumerate(forms)) for start in starts)


@pytest.mark.parametrize(
    ("name", "avoided", "found"),
    [
        ("doubt_penalty", "doubt", True),
        ("DoubtPenalty", "doubt", True),
        ("what_rewards_lack", "what_rewards_lack", True),
        ("rewards_lacking", "what_rewards_lack", False),
        ("width", "dt", False),
    ],
)
def test_words_are_found_in_names(name: str, avoided: str, found: bool) -> None:
    assert holds(name, avoided) is found


def first_places() -> dict[str, str]:
    """Return where each identifier of the house stands first, by its name."""
    places: dict[str, str] = {}
    for path in sorted(HOUSE.rglob("*.py")):
        place = path.relative_to(ROOT)
        for line, name in identifiers(ast.parse(path.read_text())):
            places.setdefault(name, f"{place}:{line}")
    return places


def test_no_identifier_has_a_word_that_is_not_used() -> None:
    places = first_places()
    found = [
        f"{place}: say {used} for {avoided}: {name}"
        for avoided, used in rows(AVOIDED)
        for name, place in places.items()
        if name not in THEIRS and holds(name, avoided)
    ]
    assert not found, "\n".join(found)


def test_no_two_classes_have_one_name() -> None:
    classes = defaultdict(list)
    for path in sorted(HOUSE.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(str(path.relative_to(ROOT)))
    doubled = {name: paths for name, paths in classes.items() if len(paths) > 1}
    assert not doubled


def test_no_module_has_a_name_that_says_nothing() -> None:
    assert not [path for path in HOUSE.rglob("*.py") if path.stem in MODULES]


def test_each_word_is_defined_once_and_used() -> None:
    words = [word.removesuffix(" (phi)") for word, _ in rows(WORDS)]
    assert len(words) > 50 and len(words) == len(set(words))
    avoided = [word for word, _ in rows(AVOIDED)]
    assert avoided == sorted(set(avoided))
    pages = [path for path in ROOT.glob("docs/*/*.md")]
    text = "\n".join(path.read_text().lower() for path in [*HOUSE.rglob("*.py"), *pages])
    flat = re.sub(r"[\s_]+", " ", text)
    assert not [word for word in words if word.lower() not in flat]


def test_meanings_use_no_word_that_is_not_used() -> None:
    avoided = [word for word, _ in rows(AVOIDED)]
    meanings = " ".join(meaning for _, meaning in rows(WORDS)).lower()
    assert not [word for word in avoided if re.search(rf"\b{word.replace('_', ' ')}\b", meanings)]
