"""An extension of griffe: sections `Example:` of docstrings are read as code, as `Examples:` are."""

from typing import Any

from griffe import Extension, Object


class Examples(Extension):
    """Rename the sections while docstrings are collected."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rename that of one object."""
        if obj.docstring is not None:
            obj.docstring.value = obj.docstring.value.replace("Example:\n", "Examples:\n")
