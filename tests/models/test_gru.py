import pytest
import torch
from torch import Tensor

from astra_data.models.history import HistoryEncoder

STEPS, COUNT = 7, 6


def by_cell(encoder: HistoryEncoder, inputs: Tensor, hidden: Tensor, start: Tensor) -> Tensor:
    """Encode step by step with torch's own cell and gradient."""
    latents = []
    for step in range(inputs.shape[1]):
        hidden = encoder.step(inputs[:, step], hidden * (1.0 - start[:, step, None]))
        latents.append(encoder.latent(hidden))
    return torch.stack(latents, dim=1)


@pytest.mark.parametrize("steps", [1, STEPS])
def test_pieces_and_their_gradients_are_those_of_torchs_cell(steps: int) -> None:
    torch.manual_seed(0)
    encoder = HistoryEncoder(3, embedding_size=5, latent_size=4).double()
    inputs = torch.randn(COUNT, steps, 3, dtype=torch.float64, requires_grad=True)
    hidden = torch.randn(COUNT, 4, dtype=torch.float64, requires_grad=True)
    # Nowhere; at the first step; at the last; in the midst; twice in a row; everywhere.
    start = torch.zeros(COUNT, steps, dtype=torch.float64)
    start[1, 0] = start[2, -1] = start[3, steps // 2] = 1.0
    start[4, steps // 2 : steps // 2 + 2] = 1.0
    start[5] = 1.0
    weights = torch.randn(COUNT, steps, 4, dtype=torch.float64)
    learned = [inputs, hidden, *encoder.parameters()]
    results = []
    for way in (encoder.pieces, lambda *given: by_cell(encoder, *given)):
        latents = way(inputs, hidden, start)
        results.append([latents, *torch.autograd.grad((latents * weights).sum(), learned)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)
    # A row that begins anew at once owes nothing to what was before.
    assert not results[0][2][1].any()
    assert results[0][2][0].abs().min() > 0


def test_without_a_start_it_is_torchs_gru() -> None:
    torch.manual_seed(0)
    encoder = HistoryEncoder(3, embedding_size=5, latent_size=4)
    inputs, hidden = torch.randn(COUNT, STEPS, 3), torch.randn(COUNT, 4)
    latents, _ = encoder(inputs, hidden)
    torch.testing.assert_close(encoder.pieces(inputs, hidden, torch.zeros(COUNT, STEPS)), latents)
