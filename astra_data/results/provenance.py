"""Where an artefact comes from: commit, package versions and machine."""

import os
import platform
from pathlib import Path
from typing import Any

import torch

from astra_data.cores import cores
from astra_data.dataset.provenance import git_commit, package_versions


def origin(device: str = "cpu") -> dict[str, Any]:
    """Return what every artefact says of its making; ask when a stage begins."""
    return {"git_commit": git_commit(), "packages": package_versions(), "machine": machine(device)}


def machine(device: str = "cpu") -> dict[str, Any]:
    """Return the processor, its cores and the memory of this machine, and the GPU if `device` is one."""
    return {
        "cpu": _cpu_name(),
        "cores": cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else None,
    }


def _cpu_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
