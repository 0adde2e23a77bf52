"""Windows of paired episodes, which the grounding model learns from."""

from dataclasses import dataclass

from torch import Tensor

RISK_STEPS = 20
"""Steps before each topple that the topple head is fitted to. The last step alone is too rare, and by then
the robot moves as it never does in a simulator without topples."""


@dataclass(frozen=True)
class PairedWindows:
    """B windows of T steps each from paired episodes; the mask marks real steps, not padding.

    Attributes:
        state: φ(s_i), (B, T, X). action: a_i, (B, T, A). previous_action: a_{i-1}, (B, T, A).
        goal: (B, T, G). simulated_next: where the abstract simulator landed, (B, T, X).
        next_state: φ(s_{i+1}), (B, T, X).
        fails_soon: (B, T), 1 where the episode fails within `RISK_STEPS`; see also `failing`.
        reward: r_i, or the residual reward, in two parts, (B, T, 2): of steps that go on, and of steps that
            end in failure; 0 in the other. Reaching the goal is detected and rewarded by the simulator.
        goes_on: (B, T), 1 where the step ends nothing: only there the first part of the reward is known.
        failed: (B, T), 1 where the step ends in a failure that R_pred is to foresee, whatever it pays.
        mask: (B, T), 1 on real steps.
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


def before_failures(fails: Tensor, mask: Tensor, steps: int) -> Tensor:
    """Return 1 at the last `steps` real steps of each episode that fails (E,), by the mask (E, T), else 0."""
    left = mask.flip(1).cumsum(1).flip(1)
    return (fails[:, None] & mask.bool() & (left <= steps)).float()
