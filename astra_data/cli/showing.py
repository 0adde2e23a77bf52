"""Tables in the terminal."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def show_table(table: "Table") -> None:
    """Print `table`, with its cells as they are: brackets and colons are no markup."""
    from rich.console import Console

    Console(markup=False, emoji=False).print(table)
