"""Paired episodes as the grounding model learns from them."""

from dataclasses import dataclass

from torch import Tensor

RISK_STEPS = 20
"""The topple head learns from so many steps before each topple: the last step alone is too rare, and by then
the robot moves as it never does in a simulator that has no topples."""


@dataclass(frozen=True)
class Windows:
    """Stretches of paired episodes; T steps each, the mask marks the real ones.

    Attributes:
        state: φ(s_i), (B, T, X). action: a_i, (B, T, A). previous_action: a_{i-1}, (B, T, A).
        goal: (B, T, G). simulated_next: where the abstract simulator landed, (B, T, X).
        next_state: φ(s_{i+1}), (B, T, X). topples_soon: (B, T), the target ends
            badly within `RISK_STEPS`.
        reward: r_i, or what the task's own lacks of it, in two parts, (B, T, 2): of steps that go on, and of
            steps that end in failure. That the goal is reached is decided, and rewarded, by the simulator.
        mask: (B, T), 1 on real steps.
    """

    state: Tensor
    action: Tensor
    previous_action: Tensor
    goal: Tensor
    simulated_next: Tensor
    next_state: Tensor
    reward: Tensor
    topples_soon: Tensor
    mask: Tensor
