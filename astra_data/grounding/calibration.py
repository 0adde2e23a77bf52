"""Probabilities that come true: cross-fitting, and Platt's scaling of log-odds."""

import torch
from torch import Tensor
from torch.nn import functional

_MOST_FOLDS = 5


def folds(fails: Tensor, recordings: Tensor) -> list[Tensor]:
    """Split episodes at random, those that fail (E,) and the others alike; return who is in each fold, (E,).

    Copies stay with the episode that they are of: `recordings` (E,) are the same for them. There are as many
    folds as recordings with a failure, at most five; none with a single one.
    """
    # Numbered as they come, so that without copies each episode is drawn for in turn.
    known: dict[int, int] = {}
    numbered = [known.setdefault(name, len(known)) for name in recordings.tolist()]
    recording = torch.tensor(numbered, device=fails.device)
    failing = torch.bincount(recording[fails], minlength=len(known)) > 0
    count = min(_MOST_FOLDS, int(failing.sum()))
    if count < 2:
        return []
    numbers = torch.empty(len(known), dtype=torch.long, device=fails.device)
    for rows in (failing.nonzero().squeeze(1), (~failing).nonzero().squeeze(1)):
        numbers[rows[torch.randperm(len(rows))]] = torch.arange(len(rows), device=rows.device) % count
    return [(numbers == fold)[recording] for fold in range(count)]


def calibration(odds: Tensor, fails: Tensor, risk_steps: int) -> tuple[Tensor, Tensor]:
    """Return by how much to scale and shift log-odds (K, N) so that they come true on steps (N,) (Platt).

    The logarithm of the scale has a standard normal prior, and the `risk_steps` before a failure count as one
    step: where failures are few, little is changed.
    """
    odds, fails = odds.double(), fails.double().expand_as(odds)
    start = [torch.zeros((), device=odds.device), fails.mean().logit() - odds.mean()]
    scale, shift = (one.double().clone().requires_grad_() for one in start)
    optimizer = torch.optim.LBFGS([scale, shift], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        surprise = functional.binary_cross_entropy_with_logits(scale.exp() * odds + shift, fails)
        total: Tensor = surprise + 0.5 * scale.square() * risk_steps / odds.shape[1]
        total.backward()
        return total

    optimizer.step(loss)
    return scale.detach().exp(), shift.detach()
