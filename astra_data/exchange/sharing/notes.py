"""What only a person can say about a dataset: a TOML file beside its card."""

from typing import Annotated

from pydantic import Field

from astra_data.core.config import Config

Text = Annotated[str, Field(min_length=1)]


class Notes(Config):
    """The human part of a dataset card; every text is Markdown and may be left out."""

    license: Text = "unknown"
    """One of the Hub's identifiers, such as "apache-2.0"."""
    summary: str = ""
    """What the dataset is: opens the card."""
    behavior: str = ""
    """Who or what acts in it, and how."""
    intended_use: str = ""
    """What it is good for."""
    limits: str = ""
    """What it does not hold, and what it should not be used for."""
