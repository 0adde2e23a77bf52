"""README, CONTRIBUTING and docs/: links lead somewhere, commands exist, snippets run, guides are short."""

import glob
import os
import re
import runpy
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick_runs import fit_quickly
from small_run import ALIGN, GROUND, TASK, TRAIN, short_task
from typer.core import TyperGroup
from typer.main import get_command

from astra_data.cli.app import app
from astra_data.core.config import Config
from astra_data.io import mapping  # noqa: F401 - has the keys of mappings
from astra_data.pipeline import recipe  # noqa: F401 - has all tables of settings
from astra_data.pipeline.stages.align import align
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.ground import ground
from astra_data.pipeline.stages.pair import pair
from astra_data.pipeline.stages.train import train

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (*map(ROOT.joinpath, ("README.md", "CONTRIBUTING.md")), *sorted((ROOT / "docs").rglob("*.md")))
}
GROUP = get_command(app)
assert isinstance(GROUP, TyperGroup)
COMMANDS = GROUP.commands
SET_UP = "pip install uv && uv run astra-data run recipes/quickstart.toml"
TEST = "pip install uv && uv run pytest"

NOT_RUN = {"minutes", "hours", "network", "installs packages", "needs logs that are not in the repository"}
"""Why a block may be left out of the run; its commands and options are checked all the same."""
MOST_NOT_RUN = 16
QUICKER = {"--episodes 50": "--episodes 4 --max-steps 300", "--episodes 200": "--episodes 6"}
"""What is written for a reader, and what is run in its place."""

BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^>\n]+) -->\n)?```(?P<language>\w+)\n(?P<text>.*?)^```$", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """One fenced block of a page. `reason`: why it is not run, if it is not."""

    language: str
    text: str
    reason: str | None

    @property
    def commands(self) -> list[list[str]]:
        """The shell commands, without comments and set-up, as lists of words."""
        lines = [part for line in self.text.replace("\\\n", "").splitlines() for part in line.split("&&")]
        words = [shlex.split(line, comments=True) for line in lines]
        return [line[2:] if line[:2] == ["uv", "run"] else line for line in words if line]


def blocks(page: str) -> list[Block]:
    return [Block(m["language"], m["text"], m["reason"]) for m in BLOCK.finditer(PAGES[page])]


@pytest.fixture(scope="session")
def quickstart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs/antmaze_quick` as its recipe leaves it, but for tiny episodes and networks.

    `runs/quickstart`, of which the pages show no more than that it is a run, is the same.
    """
    folder = tmp_path_factory.mktemp("docs")
    run = folder / "runs" / "antmaze_quick"
    out = {stage: run / stage / "astra" / "seed_0" for stage in ("ground", "train", "align")}
    collected, pairs = run / "collect" / "seed_0", run / "pair" / "seed_0"
    run.mkdir(parents=True)
    (run / "recipe.json").write_text('{"task": "antmaze-umaze", "evaluate": {"episodes": 2}}')
    with short_task(), pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        collect(TASK, CollectConfig(episodes=100, max_steps=25), out=collected)
        pair(TASK, dataset=collected, out=pairs)
        few = GROUND.model_copy(update={"updates": 2})
        ground(TASK, "astra", few, dataset=pairs, out=out["ground"])
        inputs: dict[str, Any] = {"dataset": pairs, "grounding": out["ground"]}
        train(TASK, "astra", TRAIN, out=out["train"], **inputs)
        align(ALIGN.model_copy(update={"updates": 2}), out=out["align"], **inputs)
    (run.parent / "quickstart").symlink_to(run.name)
    return folder


@pytest.fixture
def workplace(quickstart: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in a folder with the recipes, the small quickstart, and logs of a robot on wheels."""
    shutil.copytree(quickstart, tmp_path, dirs_exist_ok=True)
    (tmp_path / "recipes").symlink_to(ROOT / "recipes")
    (tmp_path / "logs").mkdir()
    rng = np.random.default_rng(0)
    for run in range(3):
        command = rng.uniform(-1, 1, (40, 2))
        position = np.cumsum(0.04 * command, axis=0) - 0.04 * command
        values = np.column_stack([position, np.zeros(40), command])
        np.savetxt(tmp_path / f"logs/{run}.csv", values, "%.4f", ",", header="x,y,heading,vx,vy", comments="")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ASTRA_DATA_HOME", raising=False)
    monkeypatch.setenv("ASTRA_DATA_CACHE", str(tmp_path / "cache"))
    return tmp_path


def run_script(words: list[str]) -> None:
    """Run a script of a page, for a smaller number than by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", [*words, "6"])
        patch.syspath_prepend(Path(words[0]).parent)
        runpy.run_path(words[0], run_name="__main__")


def run_command(words: list[str]) -> None:
    """Run one command of a page as the shell would, or fail."""
    line = shlex.join(words)
    for written, quicker in QUICKER.items():
        line = line.replace(written, quicker)
    arguments = [found for word in shlex.split(line) for found in (sorted(glob.glob(word)) or [word])]
    assert arguments[0] == "astra-data", f"only astra-data is run from pages: {line}"
    app(arguments[1:], standalone_mode=False)


@pytest.mark.parametrize("page", [name for name in PAGES if blocks(name)])
def test_the_snippets_of_a_page_run_in_order(page: str, workplace: Path) -> None:
    namespace: dict[str, Any] = {"__name__": "snippet"}
    for block in blocks(page):
        if file := re.match(r"# (\w+\.(?:py|toml))\n", block.text):
            (workplace / file[1]).write_text(block.text)
        if block.reason is not None:
            continue
        if block.language == "python":
            exec(compile(block.text, page, "exec"), namespace)
        elif block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "sh":
            for words in block.commands:
                if words[0] == "astra-data":
                    run_command(words)
                elif words[0] == "python":
                    run_script(words[1:])


def all_commands() -> Iterator[tuple[str, list[str]]]:
    for page in PAGES:
        for block in blocks(page):
            yield from ((page, words) for words in block.commands if block.language == "sh")


def test_commands_of_blocks_are_taken_by_the_command_line() -> None:
    lines = [(page, words) for page, words in all_commands() if words[0] == "astra-data"]
    assert len(lines) > 15
    for page, (_, name, *arguments) in lines:
        assert name in COMMANDS, f"{page}: no command {name}"
        COMMANDS[name].make_context(name, arguments)


def test_options_named_in_the_text_exist() -> None:
    named = [(page, code) for page, text in PAGES.items() for code in re.findall(r"`(?:astra-data )(.+?)`", text)]
    assert len(named) > 30
    faults = []
    for page, code in named:
        name, *words = code.split()
        if name not in COMMANDS:
            faults.append(f"{page}: {code}")
            continue
        parameters = COMMANDS[name].params
        known = {option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts)}
        unknown = {word for word in words if word.startswith("--")} - known
        faults += [f"{page}: {code}: no option {option}" for option in unknown]
    assert not faults, "\n".join(faults)


def test_recipe_keys_named_in_the_text_exist() -> None:
    known = set(chain.from_iterable(model.model_fields for model in subclasses(Config)))
    named = re.compile(r"`(?:\[\w+\]\s+)?(\w+)\s+=\s[^`]*`|`\[\w+\]\s+(\w+)`")
    keys = [(page, a or b) for page, text in PAGES.items() for a, b in named.findall(text)]
    assert len(keys) > 10 and [(page, key) for page, key in keys if key not in known] == []


def subclasses(model: type[Config]) -> set[type[Config]]:
    return {model}.union(*map(subclasses, model.__subclasses__()))


def test_blocks_that_are_not_run_say_why_and_are_few() -> None:
    reasons = [block.reason for page in PAGES for block in blocks(page) if block.reason is not None]
    assert set(reasons) <= NOT_RUN and len(reasons) <= MOST_NOT_RUN
    markers = [marker for text in PAGES.values() for marker in re.findall(r"<!--.*?-->", text)]
    assert len(markers) == len(reasons), "every comment stands right before its block"
    assert not [block for page in PAGES for block in blocks(page) if block.language == "python" and block.reason]


def test_every_fence_is_a_block_of_a_known_language() -> None:
    for page, text in PAGES.items():
        assert 2 * len(blocks(page)) == len(re.findall(r"^```", text, re.MULTILINE)), page
        assert {block.language for block in blocks(page)} <= {"python", "sh", "toml", "text"}, page


def words(text: str) -> int:
    return len([word for word in text.split() if re.search(r"\w", word)])


def test_pages_are_short() -> None:
    guides = {name: words(text) for name, text in PAGES.items() if name.startswith("docs/guide/")}
    assert len(guides) > 15 and not {name: count for name, count in guides.items() if count > 700}
    assert sum(guides.values()) <= 12_000
    assert sum(words(text) for name, text in PAGES.items() if name != "CONTRIBUTING.md") <= 25_000
    assert words(README) <= 1000 and words((ROOT / "CHANGELOG.md").read_text()) <= 1000


def test_every_command_and_option_has_help() -> None:
    for name, command in COMMANDS.items():
        assert command.help and all(getattr(parameter, "help", "") for parameter in command.params), name


def test_the_table_names_every_command_once() -> None:
    section = README.partition("\n## Commands\n")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    assert sorted(name for cell in cells for name in re.findall(r"`(\w+)`", cell)) == sorted(COMMANDS)


def slug(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_links_and_figures_lead_somewhere() -> None:
    dead = []
    for page in (*PAGES, "CHANGELOG.md", "SECURITY.md"):
        for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", (ROOT / page).read_text()):
            path, _, anchor = link.partition("#")
            target = Path(os.path.normpath((ROOT / page).parent / path)) if path else ROOT / page
            if not target.exists():
                dead.append(f"{page}: {link}")
            elif anchor:
                headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE)
                dead += [] if anchor in map(slug, headings) else [f"{page}: {link}"]
    assert not dead, dead


def test_the_index_leads_to_every_page() -> None:
    pages = {name.removeprefix("docs/") for name in PAGES if name.startswith("docs/")} - {"index.md"}
    assert pages == set(re.findall(r"\]\(([\w/]+\.md)\)", PAGES["docs/index.md"])) and "docs/index.md" in README


def test_nothing_that_no_registry_has_is_installed() -> None:
    """Only a folder, uv, and what a robot needs: the package itself may be on no registry."""
    asked = [(page, found) for page, text in PAGES.items() for found in re.findall(r"pip install ([^&`\n]+)", text)]
    assert {found.strip() for _, found in asked} <= {"uv", '".[all]"', "numpy onnxruntime"}, asked


def test_nothing_is_left_to_fill_in() -> None:
    for page, text in PAGES.items():
        assert re.findall(r"^[A-Z_]{4,}$|\b[A-Z]+_MINUTES\b|\bTODO\b", text, re.MULTILINE) == [], page


def test_the_rows_of_a_table_have_as_many_cells() -> None:
    for page, text in PAGES.items():
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
            assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1, (page, table)


def checks() -> list[str]:
    lines = map(str.strip, (ROOT / ".ci" / "run").read_text().splitlines())
    return [line for line in lines if line.startswith("uv run")]


def test_what_is_checked_before_a_change_is_taken_is_the_same_everywhere() -> None:
    assert SET_UP in README.splitlines()
    for page in (".ci/run", "README.md", "CONTRIBUTING.md"):
        assert TEST in (ROOT / page).read_text().splitlines()
    named = re.findall(r"^uv run .+$", PAGES["CONTRIBUTING.md"], re.MULTILINE)
    assert named[: len(checks()) + 1] == [*checks(), "uv run pytest"]
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    assert re.findall(r"^ +entry: (.+)$", hooks, re.MULTILINE) == checks()
