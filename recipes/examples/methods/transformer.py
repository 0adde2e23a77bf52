"""ASTRA with attention over the last steps in place of a GRU: another encoder is one class."""

import torch
from torch import nn
from torch.nn import functional

from astra_data.grounding.encoder import Encoder
from astra_data.grounding.fit import HistoryFit
from astra_data.methods.method import Method
from astra_data.policies.train import InSimulator

STEPS = 16


class Transformer(Encoder):
    """One layer of attention. The memory (B, M) holds embeddings of the last steps, and the latent."""

    kind = "transformer"

    def __init__(self, input_size, *, embedding_size, latent_size):
        super().__init__(input_size, embedding_size=embedding_size, latent_size=latent_size)
        self.embedding = nn.Linear(input_size, embedding_size)
        self.place = nn.Parameter(0.1 * torch.randn(STEPS, embedding_size))
        self.query, self.key, self.value = (nn.Linear(embedding_size, embedding_size) for _ in range(3))
        self.out = nn.Linear(2 * embedding_size, latent_size)
        self.width = embedding_size + 1  # of a slot: an embedding, and whether there was such a step

    def initial(self, count):
        return self.place.new_zeros(count, STEPS * self.width + self.latent_size)

    def step(self, inputs, memory):
        slots = memory[:, : STEPS * self.width].unflatten(-1, (STEPS, self.width))
        return self._memory(torch.cat([slots[:, 1:], self._slot(inputs)[:, None]], dim=1))

    def latent(self, memory):
        return memory[..., -self.latent_size :]

    def sequence(self, inputs):
        padded = functional.pad(self._slot(inputs), (0, 0, STEPS - 1, 0))
        memory = self._memory(padded.unfold(1, STEPS, 1).transpose(-1, -2))
        return self.latent(memory), memory

    def _slot(self, inputs):
        embedded = functional.elu(self.embedding(inputs))
        return torch.cat([embedded, torch.ones_like(embedded[..., :1])], dim=-1)

    def _memory(self, slots):  # (..., STEPS, width) -> (..., M)
        seen, known = slots[..., :-1] + self.place, slots[..., -1]
        last = seen[..., -1, :]
        scores = (self.query(last).unsqueeze(-2) * self.key(seen)).sum(-1) / last.shape[-1] ** 0.5
        weights = torch.softmax(scores - 1e4 * (1.0 - known), dim=-1)
        read = (weights.unsqueeze(-1) * self.value(seen)).sum(-2)
        latent = functional.layer_norm(self.out(torch.cat([last, read], dim=-1)), (self.latent_size,))
        return torch.cat([slots.flatten(-2), latent], dim=-1)


METHOD = Method(
    name="astra_transformer",
    title="ASTRA, transformer",
    fit=HistoryFit(latent=True, reward=True, encoder=Transformer),
    learn=InSimulator(reward="predicted"),
    aligns=True,
)
