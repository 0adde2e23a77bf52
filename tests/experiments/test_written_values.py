"""Values of logs as they are written into the files of a new robot."""

import numpy as np
import pytest

from astra_data.experiments.written_values import typical


def test_where_an_episode_ends_as_it_began_the_farthest_way_counts() -> None:
    episodes = [np.array(xs, float)[:, None] for xs in ([5, 7, 5], [0, 4, 0], [1, 1, 1])]
    assert typical(episodes, [False] * len(episodes))[1] == pytest.approx(0.4)
