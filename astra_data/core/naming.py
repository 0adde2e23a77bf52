"""Rows of the results: a method by its name, or followed by `_plus`, trained with the `[plus]` settings.

And where in a stage's folder what belongs to one seed of a row lies.
"""

from collections.abc import Iterable

PLUS = "_plus"


def is_plus(row: str) -> bool:
    """Tell whether a row is the variant of its method."""
    return row.endswith(PLUS)


def base_method(row: str) -> str:
    """Return the name of a row's method: `astra` of "astra" and of "astra_plus"."""
    return row.removesuffix(PLUS)


def reference_of(rows: Iterable[str]) -> str | None:
    """Return the method in whose grounded simulator all `rows` are tested: NAS, the plainest, if among them.

    Otherwise they have none in common, and each is tested in its own.
    """
    return "nas" if "nas" in map(base_method, rows) else None


def place(seed: int, percent: int | None = None) -> str:
    """Return the folder of a seed, within that of the dataset's size where there are several."""
    return f"seed_{seed}" if percent is None else f"percent_{percent:03d}/seed_{seed}"
