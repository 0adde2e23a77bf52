import torch

from astra_data.worlds.simulators import FreeStates


def test_states_are_set_row_by_row_and_those_handed_out_stay() -> None:
    states = FreeStates(torch.zeros(3, 2))
    before = states.state
    states.reset_to(torch.ones(1, 2), torch.tensor([1]))
    assert states.state.tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
    given = torch.full((3, 2), 5.0)
    states.reset_to(given)
    given.zero_()
    assert states.state.unique().tolist() == [5.0]
    assert before.unique().tolist() == [0.0]


def test_nothing_stops_a_correction() -> None:
    states = FreeStates(torch.zeros(2, 2))
    landed = torch.tensor([[1e3, -1e3], [0.0, 2.0]])
    assert torch.equal(states.settle(states.state, landed), landed)
    assert torch.equal(states.state, landed)
    assert states.blocked.tolist() == [False, False]
