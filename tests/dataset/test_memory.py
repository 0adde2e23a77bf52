import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_many_episodes_take_little_memory(tmp_path: Path) -> None:
    options = ["--episodes", "100", "--steps", "250", "--limit-mb", "1", "--folder", str(tmp_path)]
    command = [sys.executable, str(ROOT / "tools/measure_memory.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    rows = re.findall(r"│ (\w+) +│ ([\d,]+) +│ ([\d,]+) +│", done.stdout)
    assert [name for name, *_ in rows] == ["write", "double", "pair_all", "validate"], done.stderr
    assert max(int(peak.replace(",", "")) for *_, peak in rows) < 500
    assert int(rows[-1][1].replace(",", "")) > 42_000
    assert done.returncode == 1  # above the limit of 1 MiB
    assert list(tmp_path.iterdir()) == []
