import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def measured(folder: Path, **options: int) -> subprocess.CompletedProcess[str]:
    words = [word for name, value in options.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    command = [sys.executable, str(ROOT / "tools/measure_memory.py"), "--folder", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_many_episodes_take_little_memory(tmp_path: Path) -> None:
    done = measured(tmp_path, episodes=600, steps=250, limit_mb=400)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "150,000" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_too_much_memory_is_a_failure(tmp_path: Path) -> None:
    assert measured(tmp_path, episodes=2, steps=2, limit_mb=0).returncode == 1
