"""What is learned, on disk: what its `to_file` returns, and what its `from_file` asks for."""

import json
from collections.abc import Mapping
from typing import Any, Protocol

from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.own_code import explained

_PACKAGE = __name__.partition(".")[0]


class Saved(Protocol):
    """What can be saved."""

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """Return tensors and metadata (JSON values)."""
        ...


def parts_of(learned: Saved) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
    """Return the tensors and the metadata that `to_file` of something learned returns.

    Raises:
        BadInputError: it fails, or returns something else.
    """
    what = f"{type(learned).__name__}.to_file"
    with explained(what):
        returned: Any = learned.to_file()
    is_pair = isinstance(returned, tuple | list) and len(returned) == 2
    if not (is_pair and all(isinstance(values, Mapping) for values in returned)):
        raise BadInputError(
            f"{what}: expected a pair, a dict of tensors and one of JSON values, got {_kinds_in(returned)}"
        )
    tensors, metadata = returned
    faults = [
        f"{name!r} is a {type(value).__name__}, expected a torch tensor, as torch.as_tensor(value) is"
        for name, value in tensors.items()
        if not isinstance(value, Tensor)
    ]
    faults += [
        f"{name!r} is a {type(value).__name__}, expected a JSON value, or it among the tensors"
        for name, value in metadata.items()
        if not _is_json(value)
    ]
    if faults:
        raise BadInputError(f"{what}: {'; '.join(faults)}")
    return tensors, metadata


def restored[Learned](
    made: type[Learned], tensors: dict[str, Tensor], metadata: Mapping[str, Any], *device: str
) -> Learned:
    """Return what `from_file` of the class `made` returns.

    Raises:
        BadInputError: it is a class of the user's, and fails; names what it asks for and the file has not.
        KeyError, TypeError, ValueError, RuntimeError: it is one of the package, and fails.
    """
    from_file: Any = made.from_file  # type: ignore[attr-defined]
    if made.__module__.partition(".")[0] == _PACKAGE:
        return from_file(tensors, metadata, *device)  # type: ignore[no-any-return]
    what = f"{made.__name__}.from_file"
    try:
        with explained(what):
            return from_file(tensors, metadata, *device)  # type: ignore[no-any-return]
    except BadInputError as error:
        cause, line = error.__cause__, " ".join(f"{error}".split())
        asked = cause.args[0] if isinstance(cause, KeyError) and cause.args else None
        if isinstance(asked, str) and asked not in {*tensors, *metadata}:
            line = (
                f"{what} asks for {asked!r}, which its to_file did not write: the file has the tensors "
                f"{', '.join(tensors)}, and {', '.join(metadata) or 'nothing'} beside them"
            )
        raise BadInputError(f"{line}: correct it or to_file, and run that stage again") from error


def _kinds_in(returned: object) -> str:
    """Return the types of what is no pair of dicts."""
    kind = f"a {type(returned).__name__}"
    if not isinstance(returned, tuple | list):
        return kind
    return f"{kind} of {', '.join(type(value).__name__ for value in returned) or 'nothing'}"


def _is_json(value: object) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True
