"""What latents hold of target states that φ drops: ridge regressions, tested on episodes of their own."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from astra_data.dataset.columns import Column
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.plane.navigation import Navigation

_PENALTIES = torch.logspace(-6, 2, 9, dtype=torch.float64)
"""Of squared weights, in units of the inputs' and values' variance."""
_STRIDE_M = 0.25
"""To each side of a position, to see where the way to the goal leads."""
_PICKING_SHARE = 0.2
"""Share of the training episodes on which the penalty is picked."""


def dropped_values(column: Column, episodes: PairedEpisodes) -> dict[str, Tensor]:
    """Return what target states, of `column`, hold and φ drops, by name, (E, T) each.

    Entries that are an entry of φ(s) at every step are not dropped. Of a rotation there are yaw and lean: the
    cosine and sine of the heading, and where up is as the body sees it. Angles of headings likewise.
    """
    state, abstract = episodes.target_state, episodes.windows.state
    same = state.unsqueeze(-1) == abstract.unsqueeze(-2)
    kept = episodes.steps(same).all(0).any(-1).tolist()
    names = column.labels
    values: dict[str, Tensor] = {}
    for role, group in column.roles or [("invariant", slice(0, column.size))]:
        if role == "quaternion":
            values |= _turned(state[..., group])
        elif role == "heading":
            values |= _direction(names[group.start], state[..., group.start])
        else:
            entries = range(group.start, group.stop)
            values |= {names[entry]: state[..., entry] for entry in entries if not kept[entry]}
    return values


def _direction(name: str, angle: Tensor) -> dict[str, Tensor]:
    return {f"{name}, cosine": angle.cos(), f"{name}, sine": angle.sin()}


def _turned(quaternion: Tensor) -> dict[str, Tensor]:
    """Return yaw and lean of rotations (..., 4), w first, from the body's frame to the world's."""
    w, x, y, z = quaternion.unbind(-1)
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return _direction("yaw", yaw) | {
        "lean, x": 2 * (x * z - w * y),
        "lean, y": 2 * (y * z + w * x),
        "lean, z": 1 - 2 * (x * x + y * y),
    }


def way_to_goal(objective: Navigation, episodes: PairedEpisodes) -> dict[str, Tensor]:
    """Return where the way to the goal leads: the progress in m of a meter along each axis, (E, T).

    φ(s) holds it, but as no linear function: around corners the way turns.
    """
    windows = episodes.windows
    position, goal = windows.state[..., :2].flatten(0, 1), windows.goal.flatten(0, 1)
    values = {}
    for name, axis in (("way, x", (_STRIDE_M, 0.0)), ("way, y", (0.0, _STRIDE_M))):
        stride = torch.tensor(axis, device=position.device)
        progress = objective.progress(position - stride, position + stride, goal) / (2 * _STRIDE_M)
        values[name] = progress.reshape(windows.state.shape[:2])
    return values


def recent_actions(episodes: PairedEpisodes, steps: int) -> Tensor:
    """Return φ(s_i) and the `steps` actions before, (E, T, X + steps * A); zeros before the start."""
    windows = episodes.windows
    seen, earlier = [windows.state], windows.previous_action
    for _ in range(steps):
        seen.append(earlier)
        earlier = torch.cat([torch.zeros_like(earlier[:, :1]), earlier[:, :-1]], dim=1)
    return torch.cat(seen, dim=-1)


class Probed(NamedTuple):
    """Steps to probe: inputs (N, I), and the values (N, R) that are to be told from them."""

    inputs: Tensor
    values: Tensor

    @classmethod
    def of(cls, episodes: PairedEpisodes, inputs: Tensor, values: Mapping[str, Tensor]) -> "Probed":
        """Return the real steps of inputs (E, T, I) and values (E, T)."""
        return cls(
            episodes.steps(inputs).double(),
            episodes.steps(torch.stack([*values.values()], dim=-1)).double(),
        )


def picking_split(episodes: PairedEpisodes, seed: int) -> tuple[PairedEpisodes, PairedEpisodes]:
    """Split training episodes at random: to fit probes to, and to pick their penalty on."""
    unmarked = torch.randperm(len(episodes), generator=torch.Generator().manual_seed(seed))
    picking = max(1, round(_PICKING_SHARE * len(episodes)))
    return episodes.select(unmarked[picking:]), episodes.select(unmarked[:picking])


def probe(fitting: Probed, picking: Probed, fresh: Probed) -> Tensor:
    """Return R² (R,) on `fresh` of ridge regressions, each with the penalty that is best on `picking`.

    The regressions that are tested are fitted to both `fitting` and `picking`. NaN for values that are
    constant in `fresh`.
    """
    scores = torch.stack([_r2(picking, predicted) for predicted in _ridge(fitting, picking.inputs)])
    best = scores.nan_to_num(-torch.inf).argmax(0)
    both = Probed(*map(torch.cat, zip(fitting, picking, strict=True)))
    predictions = _ridge(both, fresh.inputs)
    return _r2(fresh, predictions[best, :, torch.arange(len(best))].T)


def _ridge(fitted: Probed, inputs: Tensor) -> Tensor:
    """Return predictions (P, N, R) for `inputs` (N, I), one for each penalty."""
    mean, std = fitted.inputs.mean(0), fitted.inputs.std(0).clamp_min(1e-6)
    usual = fitted.values.mean(0)
    normal = (fitted.inputs - mean) / std
    size, axes = torch.linalg.eigh(normal.T @ normal / len(normal))
    along = axes.T @ normal.T @ (fitted.values - usual) / len(normal)
    weights = axes @ (along / (size[:, None] + _PENALTIES[:, None, None]))
    predictions: Tensor = (inputs - mean) / std @ weights + usual
    return predictions


def _r2(true: Probed, predicted: Tensor) -> Tensor:
    values = true.values
    spread = (values - values.mean(0)).square().sum(0)
    return torch.where(spread > 0, 1 - (predicted - values).square().sum(0) / spread, torch.nan)
