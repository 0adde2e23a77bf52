import numpy as np

from astra_data.dataset.checkup.duplicates import Duplicates
from astra_data.dataset.columns import ACTION, STATE, Array, Episode


def episode(uid: int, state: Array, action: Array) -> Episode:
    return Episode(uid, {STATE: state, ACTION: action, "next.reward": np.full(len(state), uid, np.float32)})


def test_the_same_states_and_actions_are_a_copy() -> None:
    state, action = np.arange(12, dtype=np.float32).reshape(6, 2), np.ones(6, np.float32)
    other = state.copy()
    other[5, 1] = np.nextafter(other[5, 1], 100, dtype=np.float32)
    duplicates = Duplicates()
    for uid, (states, actions) in enumerate(
        [(state, action), (other, action), (state, 2 * action), (state[:5], action[:5])]
    ):
        duplicates.add(episode(uid, states, actions))
    assert not duplicates.findings("walks")
    duplicates.add(episode(8, state, action))
    duplicates.add(episode(9, other, action))
    (found,) = duplicates.findings("walks")
    assert found.episodes == (8, 9)
    assert found.what == "copies of other episodes: 2; 8 has the states and actions of 0"
    assert found.advice.endswith("astra-data delete walks --episode 8 --episode 9")


def test_without_states_and_actions_nothing_is_a_copy() -> None:
    duplicates = Duplicates()
    for uid in range(2):
        duplicates.add(Episode(uid, {"x": np.zeros(3, np.float32)}))
    assert not duplicates.findings("walks")
