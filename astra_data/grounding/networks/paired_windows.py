"""Windows of paired episodes, which the grounding model learns from."""

from dataclasses import dataclass

from torch import Tensor

RISK_STEPS = 20
"""Steps before each failure that `PairedWindows.fails_soon` marks."""


@dataclass(frozen=True)
class PairedWindows:
    """B windows of T steps each from paired episodes; the mask marks real steps, not padding.

    Attributes:
        state: φ(s_i), (B, T, X). action: a_i, (B, T, A). previous_action: a_{i-1}, (B, T, A).
        goal: (B, T, G). simulated_next: where the abstract simulator landed, (B, T, X).
        next_state: φ(s_{i+1}), (B, T, X).
        fails_soon: (B, T), 1 where the episode fails within `RISK_STEPS`; see also `failing`.
        reward: r_i, (B, T).
        goes_on: (B, T), 1 where R_pred learns the reward: where the step ends nothing, as simulators detect
            and pay what ends an episode; without a failure model, also where it fails.
        failed: (B, T), 1 where the step ends in a failure that no abstract state shows, whatever it pays.
        mask: (B, T), 1 on real steps.
        own_reward: the task's own reward of the step on abstract states, (B, T); None where R_pred predicts
            no residual reward, `reward` less this.
    """

    state: Tensor
    action: Tensor
    previous_action: Tensor
    goal: Tensor
    simulated_next: Tensor
    next_state: Tensor
    reward: Tensor
    goes_on: Tensor
    failed: Tensor
    fails_soon: Tensor
    mask: Tensor
    own_reward: Tensor | None = None


def before_failures(fails: Tensor, mask: Tensor, steps: int) -> Tensor:
    """Return 1 at the last `steps` real steps of each episode that fails (E,), by the mask (E, T), else 0."""
    left = mask.flip(1).cumsum(1).flip(1)
    return (fails[:, None] & mask.bool() & (left <= steps)).float()
