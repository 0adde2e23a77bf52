import pytest
import torch

from astra_data.learning.networks.residual import ResidualModel, ResidualShape


def model() -> ResidualModel:
    torch.manual_seed(0)
    made = ResidualModel(ResidualShape(state_size=4, action_size=2, hidden_size=8, layers=3))
    made.set_scales(torch.randn(50, 4), torch.randn(50, 4))
    return made


def test_step_by_step_is_the_sequence() -> None:
    net = model()
    state, simulated, action = torch.randn(3, 9, 4), torch.randn(3, 9, 4), torch.randn(3, 9, 2)
    memory = torch.randn(3, net.shape.memory_size)
    corrected, after = net.correct(state, action, simulated, memory)
    for step in range(9):
        rows = slice(step, step + 1)
        one, memory = net.correct(state[:, rows], action[:, rows], simulated[:, rows], memory)
        torch.testing.assert_close(one[:, 0], corrected[:, step])
    torch.testing.assert_close(memory, after)


def test_the_memory_is_of_the_row_and_of_every_layer() -> None:
    net = model()
    memory = torch.randn(2, net.shape.memory_size)
    given = torch.randn(2, 1, 4), torch.randn(2, 1, 2), torch.randn(2, 1, 4)
    corrected, after = net.correct(*given, memory)
    for index in range(net.shape.memory_size):
        changed = memory.clone()
        changed[0, index] += 1.0
        other, later = net.correct(*given, changed)
        assert torch.equal(other[1], corrected[1])
        assert not torch.equal(later[0], after[0])


def test_corrections_are_in_units_of_the_training_data() -> None:
    net = model()
    correction = torch.tensor([1.0, 10.0, 0.1, 0.0]) * torch.randn(1000, 4)
    net.set_scales(torch.randn(1000, 4), correction)
    with torch.no_grad():
        net.output.weight.zero_()
        net.output.bias.fill_(2.0)
    simulated = torch.randn(1, 1, 4)
    corrected, _ = net.correct(torch.randn(1, 1, 4), torch.randn(1, 1, 2), simulated, net.initial_memory(1))
    expected = 2.0 * correction.std(0).clamp_min(1e-3)
    torch.testing.assert_close((corrected - simulated)[0, 0], expected)


def test_a_correction_is_that_of_an_lstm_written_out() -> None:
    torch.manual_seed(0)
    net = ResidualModel(ResidualShape(state_size=4, action_size=2, hidden_size=8, layers=1))
    net.set_scales(1.0 + 2.0 * torch.randn(50, 4), 3.0 * torch.randn(50, 4))
    state, action, simulated = torch.randn(3, 1, 4), torch.randn(3, 1, 2), torch.randn(3, 1, 4)
    memory = torch.randn(3, 16)
    hidden, cell = memory.split(8, dim=-1)
    normal = [(one[:, 0] - net.state_mean) / net.state_std for one in (state, simulated)]
    embedded = net.embedding(torch.cat([normal[0], action[:, 0], normal[1]], dim=-1))
    embedded = torch.where(embedded > 0, embedded, 0.01 * embedded)
    lstm = dict(net.recurrence.named_parameters())
    gates = embedded @ lstm["weight_ih_l0"].T + hidden @ lstm["weight_hh_l0"].T
    gates = gates + lstm["bias_ih_l0"] + lstm["bias_hh_l0"]
    let_in, forget, candidate, out = gates.split(8, dim=-1)
    cell = forget.sigmoid() * cell + let_in.sigmoid() * candidate.tanh()
    hidden = out.sigmoid() * cell.tanh()
    correction = net.output(torch.where(hidden > 0, hidden, 0.01 * hidden)) * net.correction_std
    corrected, after = net.correct(state, action, simulated, memory)
    torch.testing.assert_close(corrected[:, 0], simulated[:, 0] + correction)
    torch.testing.assert_close(after, torch.cat([hidden, cell], dim=-1))


def test_scales_are_those_of_the_training_steps() -> None:
    net, state = model(), 5.0 + 2.0 * torch.randn(50, 4)
    net.set_scales(state, torch.zeros(50, 4))
    torch.testing.assert_close(net.state_mean, state.mean(0))
    torch.testing.assert_close(net.state_std, state.std(0))
    assert net.correction_std.tolist() == pytest.approx([1e-3] * 4)
    assert not net.initial_memory(2).any() and net.initial_memory(2).shape == (2, 2 * 3 * 8)
