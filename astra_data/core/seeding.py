"""Independent random streams per purpose, derived from one seed.

A stream depends on the seed and the purpose's name alone: adding a purpose changes no other stream, and the
same seed gives the same numbers in every process and on every machine.
"""

import hashlib

import numpy as np


def derive(seed: int, purpose: str) -> int:
    """Return the seed of `purpose`, in [0, 2^63)."""
    digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return a numpy generator for `purpose`."""
    return np.random.default_rng(derive(seed, purpose))
