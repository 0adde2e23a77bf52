"""Encoders of histories of states and actions: the interface, and a GRU."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from astra_data.core.errors import BadInputError
from astra_data.worlds.user_code import expect, explained

_LONGEST_M = 16.0  # longest wavelength of position features
_LEAST = 1e-3  # lower bound of a deviation


def mlp(
    sizes: tuple[int, ...], activation: type[nn.ELU | nn.ReLU] = nn.ELU, *, inplace: bool = False, norm: bool = False
) -> nn.Sequential:
    """Build linear layers of `sizes` with `activation`, after a `norm`, between; `inplace` is for (N, size) alone."""
    layers: list[nn.Module] = [nn.Linear(sizes[0], sizes[1])]
    for size_in, size_out in pairwise(sizes[1:]):
        if norm:
            layers.append(nn.LayerNorm(size_in))
        layers += [activation(inplace=inplace), nn.Linear(size_in, size_out)]
    return nn.Sequential(*layers)


class Members(nn.Module):
    """K networks with two hidden layers each, evaluated at once: inputs (..., I) to log-odds (K, ...)."""

    def __init__(self, count: int, input_size: int, hidden_size: int, dropout: float) -> None:
        super().__init__()
        self.count, self.dropout = count, nn.Dropout(dropout)
        self.first = nn.Linear(input_size, count * hidden_size)  # as of one layer, since all see the same
        least = hidden_size**-0.5  # as torch's layers begin

        def drawn(*sizes: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(count, *sizes).uniform_(-least, least))

        self.second_weight, self.second_bias = drawn(hidden_size, hidden_size), drawn(1, hidden_size)
        self.last_weight, self.last_bias = drawn(hidden_size, 1), drawn(1, 1)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the log-odds (K, ...) of `inputs` (..., I)."""
        hidden = self.dropout(functional.elu(self.first(inputs.flatten(0, -2))))
        hidden = hidden.unflatten(-1, (self.count, -1)).transpose(0, 1)
        hidden = self.dropout(functional.elu(torch.baddbmm(self.second_bias, hidden, self.second_weight)))
        return torch.baddbmm(self.last_bias, hidden, self.last_weight).view(self.count, *inputs.shape[:-1])


class PositionFeatures(nn.Module):
    """Sines and cosines (..., 4 * octaves) of positions (..., 2) in m, so that smooth networks place sharp walls."""

    def __init__(self, octaves: int) -> None:
        super().__init__()
        wavelengths = _LONGEST_M * 0.5 ** torch.arange(octaves)
        self.frequencies = nn.Buffer(2 * torch.pi / wavelengths)
        self.size = 4 * octaves

    def forward(self, position: Tensor) -> Tensor:
        """Return the features of `position` (..., 2)."""
        phases = (position.unsqueeze(-1) * self.frequencies).flatten(-2)
        return torch.cat([phases.sin(), phases.cos()], dim=-1)


class Encoder(nn.Module, ABC):
    """Encodes a history of states s_i and actions a_{i-1} into latents; `memory` (B, M) is never kept."""

    kind: ClassVar[str]  # names the class in files, see `ENCODERS`
    latent_size: int

    def __init__(self, input_size: int, *, embedding_size: int, latent_size: int) -> None:
        super().__init__()
        self.latent_size = latent_size

    @abstractmethod
    def initial(self, count: int) -> Tensor:
        """Return the memory (count, M) before the first step."""

    @abstractmethod
    def step(self, inputs: Tensor, memory: Tensor) -> Tensor:
        """Process one step `inputs` (B, I); return the next memory (B, M)."""

    @abstractmethod
    def latent(self, memory: Tensor) -> Tensor:
        """Return the latent (..., Z) after the last step that `memory` (..., M) holds."""

    @abstractmethod
    def sequence(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latents (B, T, Z) and memories (B, T, M) of `step` for `inputs` (B, T, I)."""


@torch.no_grad()
def check_encoder(encoder: Encoder, inputs: Tensor) -> None:
    """Refuse an encoder of the user's whose `sequence` of `inputs` (B, T, I) is not what its steps give."""
    name = type(encoder).__name__
    encoder.eval()
    with explained(f"{name}, on inputs of shape {tuple(inputs.shape)},"):
        latents, memories = encoder.sequence(inputs)
        expect(f"{name}.sequence: latents", latents, (*inputs.shape[:2], encoder.latent_size))
        memory = encoder.initial(len(inputs))
        for step, given in enumerate(inputs.unbind(1)):
            memory = encoder.step(given, memory)
            for what, found, own in (("latents", latents, encoder.latent(memory)), ("memories", memories, memory)):
                if found[:, step].shape != own.shape or not torch.allclose(found[:, step], own, rtol=1e-3, atol=1e-4):
                    raise BadInputError(f"{name}.sequence: expected the {what} of step, got others in step {step}")
    encoder.train()


class HistoryEncoder(Encoder):
    """A GRU; latents are hidden states after LayerNorm without gain, which a latent loss cannot shrink."""

    kind = "gru"

    def __init__(self, input_size: int, *, embedding_size: int, latent_size: int) -> None:
        super().__init__(input_size, embedding_size=embedding_size, latent_size=latent_size)
        self.embedding = nn.Linear(input_size, embedding_size)
        self.recurrence = nn.GRU(embedding_size, latent_size, batch_first=True)

    def initial(self, count: int) -> Tensor:
        """Return zeros (count, Z)."""
        return torch.zeros(count, self.latent_size, device=self.embedding.weight.device)

    def step(self, inputs: Tensor, memory: Tensor) -> Tensor:
        """Return the next hidden state (B, Z)."""
        (weights,) = self.recurrence.all_weights
        return torch.gru_cell(functional.elu(self.embedding(inputs)), memory, *weights)

    def latent(self, memory: Tensor) -> Tensor:
        """Return the latent of a hidden state (..., Z)."""
        return functional.layer_norm(memory, (self.latent_size,))

    def sequence(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return latents and hidden states (B, T, Z)."""
        states = self.through_episodes(inputs, self.initial(len(inputs)), torch.zeros_like(inputs[..., 0]))
        return self.latent(states), states

    def through_episodes(self, inputs: Tensor, hidden: Tensor, start: Tensor) -> Tensor:
        """Return hidden states (B, T, Z) of `inputs`, from `hidden` (B, Z), or zero where `start` (B, T) is 1."""
        embedded = functional.elu(self.embedding(inputs.transpose(0, 1)))
        (weights,) = self.recurrence.all_weights
        keep = (1.0 - start).t().unsqueeze(-1)
        if torch.is_grad_enabled():
            states = torch.as_tensor(_Recurrence.apply(embedded, hidden, keep, *weights))  # type: ignore[no-untyped-call]
        else:
            states = torch.stack([after for _, after in _stepped(embedded, hidden, keep, *weights)])
        return states.transpose(0, 1)


def _stepped(inputs: Tensor, hidden: Tensor, keep: Tensor, *weights: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the states (B, Z) of a GRU before and after each step, as `_Recurrence` does."""
    for step, kept in zip(inputs.unbind(), keep.unbind(), strict=True):
        before = hidden * kept
        hidden = torch.gru_cell(step, before, *weights)
        yield before, hidden


class _Recurrence(torch.autograd.Function):
    """A GRU over T steps whose gradient takes a quarter of torch's time on a CPU: all that can be is done at once."""

    @staticmethod
    def forward(context: FunctionCtx, inputs: Tensor, hidden: Tensor, keep: Tensor, *weights: Tensor) -> Tensor:
        """Return the states (T, B, Z) for inputs (T, B, I), from `hidden` (B, Z); `keep` is (T, B, 1)."""
        input_weight, weight, input_bias, bias = weights
        given = functional.linear(inputs, input_weight, input_bias)
        if inputs.is_cuda:  # one kernel does a step
            both = zip(*_stepped(inputs, hidden, keep, *weights), strict=True)
            before, states = map(torch.stack, both)
            gates, new = functional.linear(before, weight, bias), torch.empty_like(before)
            _open(gates, given, new)
        else:
            gates, turned = torch.empty_like(given), weight.t()
            before, new, states = (given.new_empty(*given.shape[:2], hidden.shape[-1]) for _ in range(3))
            steps = zip(*(values.unbind() for values in (given, keep, gates, before, new, states)), strict=True)
            for of_input, kept, gate, was, draft, state in steps:
                torch.mul(hidden, kept, out=was)
                torch.addmm(bias, was, turned, out=gate)
                update = _open(gate, of_input, draft)
                hidden = torch.sub(was, draft, out=state).mul_(update).add_(draft)
        context.save_for_backward(inputs, before, keep, input_weight, weight, gates, new)
        return states

    @staticmethod
    def backward(context: FunctionCtx, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of all arguments but `keep`, given that of the states (T, B, Z)."""
        (gradient,) = gradients
        inputs, before, keep, input_weight, weight, gates, new = context.saved_tensors  # type: ignore[attr-defined]
        reset, update, own_new = gates.chunk(3, dim=-1)
        by_new = (1.0 - update) * (1.0 - new * new)
        by_own_new = by_new * reset
        by_reset = by_own_new * own_new * (1.0 - reset)
        by_update = (before - new) * update * (1.0 - update)
        # Per unit of the gradient of the state after the step, that of what its three gates sum up.
        by_gates = torch.stack([by_reset, by_update, by_own_new], dim=2)
        of_gates, of_state = torch.empty_like(by_gates), torch.empty_like(before)
        later = torch.zeros_like(gradient[0])
        steps = zip(*(one.unbind() for one in (gradient, by_gates, update, keep, of_gates, of_state)), strict=True)
        for now, by_gate, share, kept, of_gate, of_this in reversed(list(steps)):
            torch.add(later, now, out=of_this)
            torch.mul(by_gate, of_this.unsqueeze(1), out=of_gate)
            later = torch.addcmul(torch.mm(of_gate.flatten(1), weight), of_this, share) * kept
        of_sums = of_gates.flatten(2).flatten(0, 1)
        own = of_sums.t() @ before.flatten(0, 1), of_sums.sum(0)
        torch.mul(of_state, by_new, out=of_gates[:, :, 2])  # the inputs' part of the third gate is not reset
        given = of_sums.t() @ inputs.flatten(0, 1), of_sums.sum(0)
        return (of_sums @ input_weight).view(inputs.shape), later, None, given[0], own[0], given[1], own[1]


def _open(gates: Tensor, given: Tensor, draft: Tensor) -> Tensor:
    """Add what inputs have `given` (..., 3 Z) to reset and update in `gates`, write the `draft` (..., Z) of the state.

    Return the update (..., Z). What remains of the third gate is what the state before gives it.
    """
    two = 2 * draft.shape[-1]
    reset, update = gates[..., :two].add_(given[..., :two]).sigmoid_().chunk(2, dim=-1)
    torch.mul(gates[..., two:], reset, out=draft).add_(given[..., two:]).tanh_()
    return update


ENCODERS: dict[str, type[Encoder]] = {HistoryEncoder.kind: HistoryEncoder}
"""The encoders that can be read, by what files call them; methods of the user's add theirs."""


def take_scales(network: nn.Module, values: Mapping[str, Tensor]) -> None:
    """Take means and deviations from the values (N, size) of each name; those of size 0 have none."""
    for name, seen in values.items():
        if seen.numel():
            getattr(network, f"{name}_mean").copy_(seen.mean(0))
            getattr(network, f"{name}_std").copy_(seen.std(0, correction=min(1, len(seen) - 1)).clamp_min(_LEAST))
