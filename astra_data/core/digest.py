"""Checksums of files."""

import hashlib
from pathlib import Path


def file_digest(path: Path) -> str:
    """Return the sha256 of the file at `path` in hex; it is read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
