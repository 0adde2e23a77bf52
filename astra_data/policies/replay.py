"""A replay buffer of a batched environment, from which windows of consecutive steps are drawn."""

from collections.abc import Mapping

import torch
from torch import Tensor

from astra_data.worlds.batched import BatchedEnv


class Replay:
    """A ring buffer of the last steps of B environments, in contiguous tensors."""

    def __init__(self, size: int, env: BatchedEnv, memory_size: int, device: torch.device) -> None:
        """Hold the last `size` steps of `env`, the same number per row, with memories of `memory_size`."""
        self._rows = size // env.num_envs
        self._added = 0
        place = self._rows, env.num_envs
        numbers = {"observation": (env.observation_size,), "action": (env.action_size,), "reward": ()}
        numbers |= {"previous_action": numbers["action"], "hidden": (memory_size,)}
        self._columns = {name: torch.empty(*place, *size, device=device) for name, size in numbers.items()}
        for name in ("terminated", "expired", "first"):
            self._columns[name] = torch.empty(place, dtype=torch.bool, device=device)

    def __len__(self) -> int:
        """Return the number of steps held per row."""
        return min(self._added, self._rows)

    def add(self, **step: Tensor) -> None:
        """Add a step of every environment.

        Args:
            step: observation (B, O); previous_action (B, A) and the policy's memory before the step, hidden
                (B, M), both zero at the start; action (B, A); reward (B,); bool (B,): terminated, expired,
                where time ran out, and first, where an episode begins.
        """
        row = self._added % self._rows
        for name, column in self._columns.items():
            column[row] = step[name]
        self._added += 1

    def cut(self) -> None:
        """End all episodes with the last step, as where time runs out: the next one does not follow it."""
        if self._added:
            last = (self._added - 1) % self._rows
            self._columns["expired"][last] |= ~self._columns["terminated"][last]

    def windows(self, count: int, length: int, burn_in: int) -> tuple[dict[str, Tensor], Tensor]:
        """Draw windows of `length` consecutive steps, plus one, by torch's global generator.

        Returns:
            the columns (count, length + 1, ...), and which steps to learn from, (count, length) bool: not
            those at the horizon, whose next observation is not kept, nor the first `burn_in` of a window
            before an episode starts in it, which only warm up the memory.
        """
        device = self._columns["reward"].device
        oldest = self._added - len(self)
        begin = oldest + torch.randint(len(self) - length, (count, 1), device=device)
        steps = (begin + torch.arange(length + 1, device=device)) % self._rows
        env = torch.randint(self._columns["reward"].shape[1], (count, 1), device=device)
        drawn = {name: column[steps, env] for name, column in self._columns.items()}
        filled = torch.arange(length, device=device) >= burn_in
        has_begun = drawn["first"][:, :-1].cumsum(1) > 0
        return drawn, ~drawn["expired"][:, :-1] & (filled | has_begun)

    def state_dict(self) -> dict[str, Tensor | int]:
        """Return the kept steps."""
        return {"added": self._added} | {name: column[: len(self)] for name, column in self._columns.items()}

    def load_state_dict(self, state: Mapping[str, Tensor | int]) -> None:
        """Continue with the steps in `state`."""
        self._added = int(state["added"])
        for name, column in self._columns.items():
            column[: len(self)] = torch.as_tensor(state[name], device=column.device)
