"""Where numbers came from: commit, machine, package versions."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]

PACKAGES = ("astra-data", "torch", "torchrl", "mujoco", "gymnasium", "lerobot", "numpy", "scipy", "rliable")
"""Packages whose versions can move a result."""


def commit() -> tuple[str | None, bool | None]:
    """Return the commit of this checkout, and whether files differ from it; None where there is no checkout.

    Published results do not count as differences: they are written by the report itself.
    """
    top = _git("rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != PACKAGE.parent:
        return None, None
    changes = _git("status", "--porcelain", "--", ":/", ":(top,exclude)recipes/results")
    return _git("rev-parse", "--verify", "--quiet", "HEAD"), None if changes is None else bool(changes)


def cpu_name() -> str:
    """Return the processor's name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_gib() -> float:
    """Return the machine's memory in GiB, to one decimal."""
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that can move a result, where installed."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(PACKAGE), *arguments], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
