"""Addresses of shared datasets: a repository on the Hugging Face Hub, or a folder at any URL."""

import re
from dataclasses import dataclass
from pathlib import Path

from astra_data.core.errors import BadInputError
from astra_data.dataset.description import VERSION
from astra_data.dataset.versions import Version

_WORD = r"[A-Za-z0-9][A-Za-z0-9._-]*"
_HUB = re.compile(rf"(hf://datasets/)?(?P<repo>{_WORD}/{_WORD})/?")
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://.+")
_VERSION = re.compile(rf"[@/](data-)?(?P<version>{VERSION.pattern})/?$")


@dataclass(frozen=True)
class Hub:
    """The repository "user/name" on the Hugging Face Hub."""

    repo: str

    def __str__(self) -> str:
        """Return it as a URL."""
        return f"hf://datasets/{self.repo}"


@dataclass(frozen=True)
class Url:
    """A folder at a URL that fsspec knows, without a slash at its end."""

    url: str

    def __str__(self) -> str:
        """Return the URL."""
        return self.url


Place = Hub | Url


def parse_place(text: str) -> Place:
    """Read "user/name", "hf://datasets/user/name", another URL, or a folder that begins with a dot, / or ~.

    Raises:
        BadInputError: it is none of these.
    """
    if hub := _HUB.fullmatch(text):
        return Hub(hub["repo"])
    if text.startswith(("/", "./", "../", "~/")):
        return Url(f"file://{Path(text).expanduser().absolute()}")
    if not _URL.fullmatch(text) or text.startswith("hf://"):
        raise BadInputError(
            f"{text}: expected user/name or hf://datasets/user/name for the Hugging Face Hub, "
            "a URL such as s3://bucket/folder or gs://bucket/folder, or a folder such as ./shared or /shared"
        )
    return Url(text.rstrip("/"))


def parse_source(text: str) -> tuple[Place, Version | None]:
    """Read a place, and the version where one is named: "user/name@data-1.2.0", "s3://…/name/data-1.2.0".

    Raises:
        BadInputError: it is not an address.
    """
    named = _VERSION.search(text)
    if named is None:
        return parse_place(text), None
    return parse_place(text[: named.start()]), Version.parse(named["version"])


def is_address(data: str | Path) -> bool:
    """Return whether `data` is an address to pull from, such as user/name or s3://…, and no folder here."""
    if Path(data).is_dir():
        return False
    return "://" in str(data) or (len(Path(data).parts) == 2 and not str(data).startswith((".", "/")))
