"""What is strange about the times of recordings."""

import numpy as np

from astra_data.exchange.tally import Tally


def test_rows_are_counted_over_blocks_and_the_first_of_each_kind_is_named() -> None:
    """A block without any names none."""
    tally, none = Tally(), np.zeros(3, bool)
    tally.count_times(none, none, lambda row: f"a {row}")
    assert tally == Tally()
    tally.count_times(none, np.array([False, True, True]), lambda row: f"b {row}")
    tally.count_times(np.array([False, False, True]), np.array([True, False, False]), lambda row: f"c {row}")
    assert (tally.still_rows, tally.still_first) == (3, "b 1")
    assert (tally.back_rows, tally.back_first) == (1, "c 2")
