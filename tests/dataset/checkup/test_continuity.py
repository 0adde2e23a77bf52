import numpy as np
import pytest

from astra_data.dataset.checkup.continuity import Continuity
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Array, Episode


def episode(uid: int, state: Array, arrived: Array) -> Episode:
    return Episode(uid, {STATE: state, NEXT_STATE: arrived})


@pytest.mark.parametrize("shape", [(6,), (6, 2)])
def test_a_step_leads_to_the_row_after_it(shape: tuple[int, ...]) -> None:
    walk = np.random.default_rng(0).normal(size=(7, *shape[1:])).astype(np.float32)
    state, arrived = walk[:-1], walk[1:].copy()
    continuity = Continuity()
    arrived[-1] = 9.0  # Whatever is after the last row.
    continuity.add(episode(0, state, arrived))
    continuity.add(episode(1, state[:1], arrived[:1]))
    assert not continuity.findings()
    off = arrived.copy()
    off[1] = np.nextafter(off[1], np.float32(100))
    off[4] += 1
    continuity.add(episode(4, state, off))
    continuity.add(episode(5, state, arrived))
    (found,) = continuity.findings()
    assert found.severity == "warning" and found.episodes == (4,)
    assert found.what == "steps whose next.observation.state is not the state of the next row: 2 of 15"


@pytest.mark.parametrize("missing", [STATE, NEXT_STATE])
def test_without_states_or_next_states_there_is_nothing_to_tell(missing: str) -> None:
    zeros = np.zeros(3, np.float32)
    columns = {STATE: zeros, NEXT_STATE: zeros + 1, ACTION: zeros}
    continuity = Continuity()
    continuity.add(Episode(0, {name: values for name, values in columns.items() if name != missing}))
    assert not continuity.findings()
