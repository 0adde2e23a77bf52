"""What a file holds, as one number."""

import hashlib
from pathlib import Path


def file_digest(path: Path) -> str:
    """Return the sha256 of a file of any size, which is read piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
