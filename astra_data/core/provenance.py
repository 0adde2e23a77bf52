"""Provenance of artifacts: commit, package versions and machine."""

import os
import platform
import re
import subprocess
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

MEMORY_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container in bytes, or "max"; absent outside of one
ROOT = Path(__file__).parents[2]
CODE = ("astra_data", "pyproject.toml", "uv.lock")  # changes of these make a checkout dirty; of notes and recipes not
PACKAGES = (
    *("astra-data", "gymnasium", "gymnasium-robotics", "lerobot", "mujoco"),
    *("numpy", "pandas", "scipy", "torch"),
)  # packages whose versions can change a result


@cache
def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the installed `PACKAGES`; cached."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


@cache
def git_commit() -> str | None:
    """Return the commit of this process's checkout, with "-dirty" if its code was changed; None outside of one."""
    # In a hook, Git's variables point at the repository of the hook.
    free = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=free).stdout.strip()

    if not (ROOT / ".git").exists():
        return None
    try:
        head = git("rev-parse", "--verify", "HEAD")
        return f"{head}-dirty" if git("status", "--porcelain", "--", *CODE) else head
    except (OSError, subprocess.CalledProcessError):
        return None


def origin(device: str = "cpu") -> dict[str, Any]:
    """Return the provenance that every artifact records; call it when a stage begins."""
    return {"git_commit": git_commit(), "packages": package_versions(), "machine": machine(device)}


def machine(device: str = "cpu") -> dict[str, Any]:
    """Return the processor, its cores and the memory of this machine, and the GPU if `device` is one."""
    gpu = None
    if device.startswith("cuda"):
        import torch  # slow; only needed on GPUs

        gpu = torch.cuda.get_device_name(device)
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else None
    cpu = found[1].strip() if found else platform.processor() or platform.machine()
    return {"cpu": cpu, "cores": cores(), "memory_gib": round(memory_bytes() / 2**30, 1), "gpu": gpu}


def memory_bytes() -> int:
    """Return this machine's memory in bytes, or the container's limit where that is less."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = MEMORY_LIMIT.read_text().strip() if MEMORY_LIMIT.exists() else "max"
    return machine if limit == "max" else min(machine, int(limit))


def cores() -> int:
    """Return the number of processor cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
