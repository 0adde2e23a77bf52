"""Paired episodes of the ant's shapes out of a few tensors: what a test does not name is nothing."""

import torch
from torch import Tensor

from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows


def toy_episodes(
    state: Tensor,
    action: Tensor,
    *,
    next_state: Tensor,
    simulated_next: Tensor | None = None,
    goal: Tensor | None = None,
    mask: Tensor | None = None,
    reward: Tensor | None = None,
    failed: Tensor | None = None,
    terminated: Tensor | None = None,
    target_state: Tensor | None = None,
) -> PairedEpisodes:
    """Return E episodes of T steps with `state` (E, T, X) and `action` (E, T, A).

    The other shapes are as in `PairedEpisodes` and `PairedWindows`. By default the simulator lands where the
    target does, every step is real, and what fails is terminated.
    """
    nothing = torch.zeros(state.shape[:2])
    none = torch.zeros(*state.shape[:2], 2)
    failed = nothing if failed is None else failed
    ended = failed.bool() if terminated is None else terminated
    real = torch.ones_like(nothing) if mask is None else mask
    paid = nothing if reward is None else reward
    windows = PairedWindows(
        state=state,
        action=action,
        previous_action=torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], dim=1),
        goal=none if goal is None else goal,
        simulated_next=next_state if simulated_next is None else simulated_next,
        next_state=next_state,
        reward=paid,
        goes_on=real * (1.0 - ended.float()),
        failed=failed,
        fails_soon=nothing,
        mask=real,
    )
    return PairedEpisodes(
        target_state=torch.zeros(*state.shape[:2], 29) if target_state is None else target_state,
        terminated=ended,
        windows=windows,
        reference="toy@data-1.0.0",
        content_hash="0",
        has_rewards=True,
        uids=torch.arange(len(state)),
        recordings=torch.arange(len(state)),
    )


def no_episodes() -> PairedEpisodes:
    nothing = torch.zeros(1, 1, 1)
    return toy_episodes(nothing, nothing, next_state=nothing)
