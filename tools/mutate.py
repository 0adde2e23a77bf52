"""How many small changes of the code do the tests notice? Mutants are drawn with Cosmic Ray.

    uv run --with cosmic-ray python tools/mutate.py grounding policies --count 40 --seed 0

First the tests have to pass without a change. Then each mutant is run, in a copy of the checkout, against the
test files that import its module, the one of the same name first. Left out are mutants that change nothing a
test could see: type unions, defaults of settings, decorators. Survivors are printed as diffs: read them, for
some are equivalent.
"""

import ast
import difflib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated

import typer
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import MutationVisitor
from cosmic_ray.plugins import get_operator, operator_names
from rich.console import Console
from rich.progress import Progress

ROOT = Path(__file__).parents[1]
SKIPPED = ("BitOr", "ExceptionReplacer", "RemoveDecorator", "VariableInserter", "VariableReplacer")
"""The exception replacer fails at dotted names."""
PATIENCE_S = 600
"""A mutant whose tests take longer counts as noticed."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file, whose path is below the checkout."""

    path: Path
    operator: str
    code: str

    def diff(self) -> str:
        """Return the change as a unified diff."""
        before = (ROOT / self.path).read_text().splitlines()
        lines = difflib.unified_diff(before, self.code.splitlines(), str(self.path), str(self.path), "", "", 0, "")
        return "\n".join(list(lines)[2:])


def draw_mutants(path: Path, count: int, draw: random.Random) -> list[Mutant]:
    """Draw mutants of a file, at most one per place and operator, but for those that no test could see."""
    source = (ROOT / path).read_text()
    settings = {
        line
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ClassDef)
        for field in node.body
        if isinstance(field, ast.AnnAssign)
        for line in range(field.lineno, (field.end_lineno or field.lineno) + 1)
    }
    nodes = list(ast_nodes(get_ast(source)))
    places = [
        (name, occurrence)
        for name in operator_names()
        if not any(skipped in name for skipped in SKIPPED)
        for occurrence in range(sum(len(list(get_operator(name)().mutation_positions(n))) for n in nodes))
    ]
    draw.shuffle(places)
    found: list[Mutant] = []
    for name, occurrence in places:
        if len(found) == count:
            break
        code = MutationVisitor.mutate_code(source, get_operator(name)(), occurrence)
        pairs = zip(source.splitlines(), code.splitlines(), strict=False)
        changed = {number for number, (old, new) in enumerate(pairs, start=1) if old != new}
        if changed and not changed & settings:
            found.append(Mutant(path, name, code))
    return found


@cache
def imported_by(test: Path) -> set[str]:
    """Return the names that a test file imports from modules."""
    return {
        f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(test.read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def tests_of(path: Path) -> list[str]:
    """Return the mirrored test file, that of the room, and those that import the module at `path`."""
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    folder = Path("tests", *path.parts[1:-1])
    found = [
        test for test in (folder / f"test_{path.name}", folder / f"test_{folder.name}.py") if (ROOT / test).exists()
    ]
    for test in sorted(ROOT.glob("tests/**/test_*.py")):
        if any(one == module or one.startswith(f"{module}.") for one in imported_by(test)):
            found.append(test.relative_to(ROOT))
    return [str(test) for test in dict.fromkeys(found)]


def drawn_from(files: list[Path], count: int, draw: random.Random) -> list[Mutant]:
    """Draw mutants: files by their length, then any of a file's mutants."""
    lengths = [len((ROOT / file).read_text().splitlines()) for file in files]
    shares = Counter(draw.choices(files, lengths, k=count))
    found = []
    for file, share in sorted(shares.items()):
        found += draw_mutants(file, share, draw)
    return found


def is_noticed(mutant: Mutant, copy: Path, tests: list[str]) -> bool:
    """Run the tests on the mutant in a copy of the checkout."""
    target = copy / mutant.path
    target.write_text(mutant.code)
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", *tests]
    settings = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, cwd=copy, env=settings, capture_output=True, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        return True
    finally:
        shutil.copy(ROOT / mutant.path, target)
    return done.returncode != 0


def main(
    rooms: Annotated[list[str], typer.Argument(help="Rooms or files below astra_data.")],
    count: Annotated[int, typer.Option(help="Mutants to draw.", min=1)] = 40,
    seed: Annotated[int, typer.Option(help="Of the draw.")] = 0,
    jobs: Annotated[int, typer.Option(help="Mutants at a time.", min=1)] = 2,
) -> None:
    """Draw mutants of the rooms and count those that the tests notice."""
    console = Console()
    unknown = [room for room in rooms if not (ROOT / "astra_data" / room).exists()]
    if unknown:
        raise typer.BadParameter(f"expected rooms or files below astra_data, got {', '.join(unknown)}")
    files = [
        file.relative_to(ROOT)
        for room in rooms
        for file in (
            [ROOT / "astra_data" / room] if room.endswith(".py") else (ROOT / "astra_data" / room).rglob("*.py")
        )
    ]
    tested = {file: tests for file in files if (tests := tests_of(file))}
    console.print(f"not run, for no test imports them: {', '.join(map(str, set(files) - set(tested))) or 'none'}")
    drawn = drawn_from(sorted(tested), count, random.Random(seed))
    sound = [Mutant(file, "none", (ROOT / file).read_text()) for file in dict.fromkeys(one.path for one in drawn)]
    noticed: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool, Progress(console=console) as bar:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            copy = Path(folder) / str(number)
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", ".*_cache", "runs", "datasets"))
            copies.put(copy)

        def run(mutant: Mutant) -> None:
            copy = copies.get()
            seen = is_noticed(mutant, copy, tested[mutant.path])
            copies.put(copy)
            if mutant in sound:
                assert not seen, f"the tests of {mutant.path} fail without any change: mend them first"
            elif seen:
                noticed[mutant.path.parts[1]] += 1
            else:
                console.print(f"\nsurvived ({mutant.operator}):\n{mutant.diff()}", markup=False)
            bar.advance(task)

        task = bar.add_task("mutants", total=len(sound) + len(drawn))
        list(pool.map(run, sound + drawn))
    for room, of in sorted(Counter(mutant.path.parts[1] for mutant in drawn).items()):
        console.print(f"{room}: {noticed[room]} of {of}")
    console.print(f"{noticed.total()} of {len(drawn)} mutants noticed ({noticed.total() / len(drawn):.0%})")


if __name__ == "__main__":
    typer.run(main)
