import pytest
from rich.table import Table

from astra_data.cli.arguments import show_table


def test_cells_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("field")
    cells = ("x[m]", "rate[/s]", "pose:x:raw")
    for cell in cells:
        table.add_row(cell)
    show_table(table)
    shown = capsys.readouterr().out
    assert all(cell in shown for cell in cells)
