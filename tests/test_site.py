"""The documentation's site: built strictly, with what pages link to, and with a reference that is whole."""

import inspect
import json
import os
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from html_pages import Page, read_page
from markdown_it import MarkdownIt
from typer.testing import CliRunner

import astra_data
from astra_data.cli.app import app
from astra_data.pipeline.recipe import Recipe

ROOT = Path(__file__).parents[1]
DOCS = sorted(path.relative_to(ROOT / "docs").as_posix().removesuffix(".md") for path in (ROOT / "docs").rglob("*.md"))
NOTEBOOKS = sorted((ROOT / "docs/guide/notebooks").glob("*.ipynb"))
COUNTED = {"blockquote", "em", "h2", "h3", "img", "li", "pre", "strong", "td", "tr"}
SCHEMA: dict[str, Any] = Recipe.model_json_schema()
TABLES = [name for name in SCHEMA["properties"] if name not in {"plus", "user_methods"}]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@cache
def article(file: Path) -> Page:
    text = file.read_text()
    return read_page(text[text.index("<article") : text.index("</article>")] + "</article>")


def counted(page: Page) -> Counter[str]:
    return Counter(tag for tag, _ in page.tags if tag in COUNTED)


def test_links_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    texts = {file: file.read_text() for file in site.rglob("*.html") if file.name != "404.html"}
    ids = {file: set(re.findall(r'\bid="([^"]+)"', text)) for file, text in texts.items()}
    assert len(texts) > 100
    dead, elsewhere = [], []
    for file, text in texts.items():
        elsewhere += re.findall(r'<(?:script|img|link)[^>]*(?:src|href)="?((?:https?:)?//[^">]*)', text)
        for link in set(re.findall(r'\b(?:href|src)="([^"]*)"', text)):
            parts = urlsplit(unescape(link))
            if parts.scheme or parts.netloc:
                continue
            target = Path(os.path.normpath(file.parent / unquote(parts.path))) if parts.path else file
            target = target / "index.html" if target not in texts and target.is_dir() else target
            if not target.is_file() or (parts.fragment and unquote(parts.fragment) not in ids[target]):
                dead.append(f"{file.relative_to(site)}: {link}")
    assert not dead, "\n".join(dead)
    assert not elsewhere


def test_every_page_is_in_the_navigation_and_shows_what_github_shows(site: Path) -> None:
    navigation = (site / "404.html").read_text()  # which has nothing else
    for name in DOCS:
        place = "" if name == "index" else f"{name}/"
        assert f'href="/{place or "."}"' in navigation
        markdown = MarkdownIt("commonmark").enable("table").render((ROOT / f"docs/{name}.md").read_text())
        assert counted(article(site / place / "index.html")) == counted(read_page(markdown)), name


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_notebooks_are_pages_with_what_they_printed_and_drew(site: Path, path: Path) -> None:
    navigation = (site / "404.html").read_text()
    assert f'href="/guide/notebooks/{path.stem}/"' in navigation
    found = article(site / f"guide/notebooks/{path.stem}/index.html")
    code = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    printed = [output for cell in code for output in cell["outputs"]]
    pictures = [output["data"]["image/png"] for output in printed if "image/png" in output.get("data", {})]
    drawn = {picture["src"] for picture in found.attributes("img")}
    assert drawn == {f"data:image/png;base64,{picture}" for picture in pictures}
    assert len(found.attributes("pre")) == len(code) + len(printed) - len(pictures)
    for output in printed:
        assert " ".join("".join(output.get("text", [])).split()) in found.text
    assert (site / f"guide/notebooks/{path.name}").read_bytes() == path.read_bytes()


def models_of(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the models that a key's schema names."""
    given = [schema, *schema.get("anyOf", []), *schema.get("oneOf", [])]
    return [SCHEMA["$defs"][part["$ref"].rpartition("/")[2]] for part in given if "$ref" in part]


def agrees(row: list[str], key: str, model: dict[str, Any], usual: dict[str, Any]) -> bool:
    """Tell whether a row of the reference has the default, the bounds and the meaning of a key's schema."""
    schema = model["properties"][key]
    kind, default, _, meaning = row
    made: object = {} if "additionalProperties" in schema else None  # by a factory, which the schema does not tell
    known = usual.get(key, schema.get("default", made))
    expected = "required" if key in model.get("required", []) else "" if known is None else json.dumps(known)
    bounds = [schema, *schema.get("anyOf", []), schema.get("items", {}), *schema.get("prefixItems", [])]
    least = [f"≥ {part['minimum']:g}" for part in bounds if "minimum" in part]
    least += [f"> {part['exclusiveMinimum']:g}" for part in bounds if "exclusiveMinimum" in part]
    return (
        default.removeprefix("the task's, else ") == expected
        and all(bound in kind.replace(".0", "") for bound in least)
        and meaning == " ".join(schema["description"].replace("`", "").split())
    )


def test_every_key_of_recipes_has_its_default_and_meaning(site: Path) -> None:
    sections = article(site / "reference/recipe_keys/index.html").sections
    tables = {title: {key: rest for key, *rest in lines[1:]} for title, lines in sections.items()}
    for table in TABLES:
        schema = SCHEMA["properties"][table]
        models = models_of(schema)
        if not models:
            assert agrees(tables["Keys of recipes"][table], table, SCHEMA, {}), table
        for model in models:
            rows = tables[f"[{table}]"]
            if len(models) > 1:
                rows = rows | tables[f'[{table}] learner = "{model["properties"]["learner"]["const"]}"']
            assert sorted(rows) == sorted(model["properties"]), table
            faults = [key for key in rows if not agrees(rows[key], key, model, schema.get("default") or {})]
            assert not faults, table


def named_by_help(*words: str) -> list[str]:
    """Return the commands, arguments and options that `--help` lists, as they are written there."""
    text = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "400", "TERM": "dumb"}).output
    names = re.findall(r"^│ [* ]*(\S+)  .*│$", text, re.MULTILINE)
    return [name.removesuffix("...") for name in names if name != "--help"]


def test_every_command_and_option_that_help_names_is_in_the_reference(site: Path) -> None:
    sections = article(site / "reference/command_line/index.html").sections
    commands = [name for name in named_by_help() if not name.startswith("-")]
    groups = [("recipes", name) for name in named_by_help("recipes")]
    everything = {"astra-data": ()} | {
        " ".join(("astra-data", *words)): words for words in [*zip(commands, strict=True), *groups]
    }
    assert everything.keys() == sections.keys() - {"The command line"}
    missing = []
    for title, words in everything.items():
        shown = [row[0] for row in sections[title][1:]]
        of_commands = commands if not words else [name for _, name in groups] if words == ("recipes",) else []
        named = [name for name in named_by_help(*words) if name not in of_commands]
        missing += [(title, name) for name in named if name not in " ".join(shown)]
        assert len(named) >= len(shown), title
    assert not missing, missing


def test_every_public_name_is_in_the_reference_with_its_docstring(site: Path) -> None:
    reference = article(site / "reference/python/index.html")
    ids = {attributes.get("id") for _, attributes in reference.tags}
    for name in astra_data.__all__:
        assert f"astra_data.{name}" in ids
        public = getattr(astra_data, name)
        about = (inspect.getdoc(public) or "").partition("\n")[0].replace("`", "")
        assert isinstance(public, dict) or about in reference.text


def test_search_finds_guides_before_results_and_no_sources(site: Path) -> None:
    found = json.loads((site / "search/search_index.json").read_text())["docs"]
    boosts = {page["location"].partition("#")[0]: page.get("boost", 1) for page in found}
    assert not [place for place in boosts if place.startswith("repository/")]
    guides = [boost for place, boost in boosts.items() if place.startswith("guide/")]
    results = [boost for place, boost in boosts.items() if place.startswith("results/")]
    assert min(guides) > 1 > max(results)
