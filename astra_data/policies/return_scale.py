"""The size of discounted returns, by which rewards are divided so that a critic learns values of about 1."""

import torch
from torch import Tensor

_LARGEST = 10.0
"""Scaled rewards are clipped to this."""


class ReturnScale:
    """The running deviation of discounted sums of B rows' rewards, as in VecNormalize of OpenAI Baselines."""

    def __init__(self, num_envs: int, discount: float, device: torch.device) -> None:
        """Begin with nothing seen."""
        self.discount = discount
        self.sums = torch.zeros(num_envs, device=device)
        self.count, self.mean, self.var = torch.tensor([1e-4, 0.0, 1.0], dtype=torch.float64, device=device)

    def scaled(self, reward: Tensor, done: Tensor) -> Tensor:
        """Take in the rewards (B,) of a step, after which rows may be `done` (B,), and return them scaled."""
        self.sums = self.sums * self.discount + reward
        sums, count = self.sums.double(), len(reward)
        apart, total = sums.mean() - self.mean, self.count + count
        spread = self.var * self.count + sums.var(correction=0) * count
        self.var = (spread + apart.square() * self.count * count / total) / total
        self.mean, self.count = self.mean + apart * count / total, total
        self.sums = torch.where(done, 0.0, self.sums)
        deviation = (self.var + 1e-8).sqrt().float()
        return torch.clamp(reward / deviation, -_LARGEST, _LARGEST)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs."""
        return {"sums": self.sums, "moments": torch.stack([self.count, self.mean, self.var])}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.sums = state["sums"].to(self.sums.device)
        self.count, self.mean, self.var = state["moments"].to(self.sums.device)
