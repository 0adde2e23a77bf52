"""The part of a dataset card that a person writes, a TOML file."""

from typing import Annotated

from pydantic import Field

from astra_data.core.config import Config

Text = Annotated[str, Field(min_length=1)]


class Notes(Config):
    """The hand-written part of a dataset card; every text is Markdown and optional."""

    license: Text = "unknown"
    """One of the Hub's identifiers, such as "apache-2.0"."""
    summary: str = ""
    """What the dataset is; shown at the top of the card."""
    behavior: str = ""
    """Who or what acts in it, and how."""
    intended_use: str = ""
    """What it is meant for."""
    limits: str = ""
    """What it does not contain, and what it should not be used for."""
