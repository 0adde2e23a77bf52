"""Errors of one line about tensors that are not as expected, and about what returns them."""

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.objective import Objective
from astra_data.worlds.own_code import explained
from astra_data.worlds.protocols import AbstractSimulator

_TOLERANCE = 1e-4
"""Between states, relative to their size: simulators compute in single precision."""


def expect(
    what: str,
    found: object,
    shape: tuple[int, ...],
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> Tensor:
    """Return `found`, a finite tensor of `shape`, where -1 stands for any length.

    Raises:
        BadInputError: it is something else.
    """
    found = expect_tensor(what, found)
    fits = found.dim() == len(shape) and all(
        size in (-1, length) for size, length in zip(shape, found.shape, strict=True)
    )
    if not fits:
        expected = str(shape).replace("-1", "any")
        raise BadInputError(f"{what}: expected shape {expected}, got {tuple(found.shape)}")
    if dtype is not None and found.dtype != dtype:
        raise BadInputError(f"{what}: expected {dtype}, got {found.dtype}")
    if device is not None and found.device != device:
        raise BadInputError(
            f"{what}: expected a tensor on {device}, where its inputs are, got {found.device}"
        )
    if not found.isfinite().all():
        raise BadInputError(f"{what}: expected finite numbers, got {first(found[~found.isfinite()])}")
    return found


def expect_same(what: str, shown: object, expected: Tensor, where: str = "") -> None:
    """Refuse states (B, X), `shown`, that are not the `expected` ones but for rounding.

    Raises:
        BadInputError: they are others; tells those that are furthest apart.
    """
    shown = expect(what, shown, tuple(expected.shape))
    if not torch.allclose(shown, expected, rtol=_TOLERANCE, atol=_TOLERANCE):
        row, entry = ((shown - expected).abs() == (shown - expected).abs().max()).nonzero()[0].tolist()
        raise BadInputError(
            f"{what} {where}".rstrip()
            + f": expected {first(expected[row, entry]):g} in row {row}, entry {entry}, got "
            f"{first(shown[row, entry]):g}"
        )


def expect_tensor(what: str, found: object) -> Tensor:
    """Return `found`, a tensor.

    Raises:
        BadInputError: it is something else.
    """
    if not isinstance(found, Tensor):
        raise BadInputError(f"{what}: expected a torch tensor, got a {type(found).__name__}")
    return found


def stepped(simulator: AbstractSimulator, command: Tensor, what: str) -> Tensor:
    """Return the states (B, X) that a step with `command` (B, A) leads to; errors begin with `what`.

    Raises:
        BadInputError: the step fails, returns no tensor, or changes the states that were handed out before.
    """
    with explained(what):
        before = simulator.state
        kept = before.clone()
        landed = simulator.step(command)
    landed = expect_tensor(what, landed)
    if not torch.equal(before, kept):
        raise BadInputError(f"{what} changes the states handed out before: expected a new tensor")
    return landed


def first(values: Tensor) -> float:
    """Return the first of `values`, of any shape."""
    return float(values.flatten()[0])


def judged(objective: Objective, name: str, state: Tensor, goal: Tensor) -> Tensor:
    """Return which states (B, X) are "reached" or "missed", as `name` says, (B,) bool.

    Raises:
        BadInputError: the objective fails, or returns something else.
    """
    what = f"objective.{name}(state, goal)"
    with explained(what):
        found = getattr(objective, name)(state, goal)
    return expect(what, found, (len(state),), torch.bool, state.device)


def paid(objective: Objective, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
    """Return the rewards (B,) of steps between states (B, X).

    Raises:
        BadInputError: the objective fails, or returns something else.
    """
    what = "objective.reward(before, after, goal, failed)"
    with explained(what):
        found = objective.reward(before, after, goal, failed)
    return expect(what, found, (len(after),), device=after.device)
