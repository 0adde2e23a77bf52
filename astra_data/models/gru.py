"""A gated recurrent unit over sequences that begin anew in their midst, with its gradient written out.

torch's own GRU knows no beginnings within a sequence, and its gradient on a CPU costs more: it sums the
gradient of the weights step by step. Here only what depends on the step before runs in a loop.
"""

from typing import Any

import torch
from torch import Tensor


def gru(inputs: Tensor, hidden: Tensor, start: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Run a GRU, in the layout of `torch.nn.GRU`, over sequences; return the hidden states (T, B, H).

    Args:
        inputs: of the gates r, z and n, already projected, (T, B, 3H).
        hidden: before the first step, (B, H).
        start: 1 where the hidden state is emptied before the step, (T, B).
        weight: from the hidden state to the gates, (3H, H).
        bias: of these, (3H,).
    """
    keep = 1.0 - start.unsqueeze(-1)
    states: Tensor = _Gru.apply(inputs, hidden, keep, weight, bias)  # type: ignore[no-untyped-call]
    return states


class _Gru(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives it no type
        inputs: Tensor,
        hidden: Tensor,
        keep: Tensor,
        weight: Tensor,
        bias: Tensor,
    ) -> Tensor:
        steps, count, size = len(inputs), *hidden.shape
        previous = inputs.new_empty(steps, count, size)
        states = torch.empty_like(previous)
        # Columns: the gates r, z, n, and what the hidden state gives to n.
        gates = inputs.new_empty(steps, count, 4 * size)
        projection, two = weight.t(), 2 * size
        for step in range(steps):
            before = torch.mul(hidden, keep[step], out=previous[step])
            now, given = gates[step], inputs[step]
            recurrent = torch.addmm(bias, before, projection)
            torch.add(given[:, :two], recurrent[:, :two], out=now[:, :two]).sigmoid_()
            now[:, 3 * size :] = recurrent[:, two:]
            reset, update, new, _ = now.chunk(4, dim=-1)
            torch.addcmul(given[:, two:], reset, recurrent[:, two:], out=new).tanh_()
            hidden = torch.lerp(new, before, update, out=states[step])
        ctx.save_for_backward(previous, gates, keep, weight)
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,  # noqa: ANN401 - torch gives it no type
        of_states: Tensor,
    ) -> tuple[Tensor, Tensor, None, Tensor, Tensor]:
        previous, gates, keep, weight = ctx.saved_tensors
        steps, count, size = previous.shape
        reset, update, new, recurrent = gates.chunk(4, dim=-1)
        # What a change of the hidden state owes to each projection: derivatives of the gates.
        by_new = (1.0 - update) * (1.0 - new * new)
        by_update = (previous - new) * update * (1.0 - update)
        by_reset = by_new * recurrent * reset * (1.0 - reset)
        local = torch.stack([by_reset, by_update, by_new * reset], dim=2)
        of_gates = torch.empty_like(local)
        total = torch.empty_like(previous)
        of_hidden = torch.zeros_like(previous[0])
        for step in range(steps - 1, -1, -1):
            now = torch.add(of_states[step], of_hidden, out=total[step])
            torch.mul(local[step], now.unsqueeze(1), out=of_gates[step])
            of_hidden = torch.addmm(now * update[step], of_gates[step].flatten(1), weight).mul_(keep[step])
        flat = of_gates.view(-1, 3 * size)
        of_inputs = of_gates.clone()
        torch.mul(by_new, total, out=of_inputs[:, :, 2])
        return (
            of_inputs.view(steps, count, -1),
            of_hidden,
            None,
            flat.t() @ previous.view(-1, size),
            flat.sum(0),
        )
