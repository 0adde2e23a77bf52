"""Random streams per purpose, derived from one seed: each depends on the seed and the purpose's name alone."""

import hashlib

import numpy as np
from numpy.typing import NDArray


def derive(seed: int, purpose: str) -> int:
    """Return the seed of `purpose`, in [0, 2^63)."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{purpose}".encode()).digest()[:8], "big") >> 1


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return a numpy generator for `purpose`."""
    return np.random.default_rng(derive(seed, purpose))


def fresh_seed() -> int:
    """Return a seed that nobody gave, another one at each call."""
    return int(np.random.default_rng().integers(2**62))


def held_out_episodes(episodes: int, share: float, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Draw a `share` of so many episodes to hold out, the same in every stage; return the others' numbers and those."""
    order = generator(seed, "held-out episodes").permutation(episodes)
    count = max(1, round(share * episodes)) if share else 0
    return order[count:], order[:count]
