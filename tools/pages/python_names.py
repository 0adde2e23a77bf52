"""The page of the reference about the public names of the package, from their docstrings."""

import re

import astra_data

_INTRODUCTION = """# The Python package

What `from astra_data import ...` gives.
The letters of shapes are in the [glossary](../glossary.md#letters-in-shapes).
"""


def python_names() -> str:
    """Return the page: the names by the groups of the package's own docstring, filled in by mkdocstrings."""
    groups = re.findall(r"^(\S.*?)  +(\S.*)$", astra_data.__doc__ or "", re.MULTILINE)
    grouped = [name for _, names in groups for name in names.split()]
    if sorted(grouped) != sorted(astra_data.__all__):
        differing = sorted(set(grouped) ^ set(astra_data.__all__))
        raise ValueError(f"the docstring of astra_data and its __all__ differ in {', '.join(differing)}")
    sections = [
        f"\n## {title.capitalize()}\n\n" + "\n".join(f"::: astra_data.{name}\n" for name in names.split())
        for title, names in groups
    ]
    return _INTRODUCTION + "".join(sections)
