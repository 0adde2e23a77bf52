"""COMPASS: identify the simulator's parameters with a causal model of the trajectory gap.

After Huang et al., "What Went Wrong? Closing the Sim-to-Real Gap via Differentiable Causal Discovery" (CoRL
2023), from recorded episodes alone.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.checkpoint import resumed, save_state
from astra_data.core.config import AtOnce, Count, own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.core.stopwatch import Stopwatch
from astra_data.grounding.fit import Fitting
from astra_data.grounding.parameters import IdentifiedParameters
from astra_data.grounding.replays import ReplayWindows, beginnings, trajectory_gaps
from astra_data.learning.networks.causal import CausalConfig, descend, fit_causes
from astra_data.methods.method import Method, Table
from astra_data.training.train import InSimulator
from astra_data.worlds.variation import AnyVariation, Variation

Mask = dict[str, dict[str, float]]
"""The probability that each parameter affects each gap, by their names. A gap is the mean over a window of
the distance between simulator and target in one of the task's quantities."""


class CompassConfig(AnyVariation, CausalConfig):
    """Ranges of the parameters, and how they are identified; the paper prints nothing of the latter.

    Only the parameters in `Variation.steering` are identified. The others keep their ranges, and are drawn
    from them in policy training.
    """

    iterations: Count = 5
    """Number of iterations; each replays windows, fits the causal model and updates the parameters."""
    contexts: Annotated[int, Field(ge=2)] = 128
    """Parameter sets per iteration; every window is replayed with each."""
    windows: Annotated[int, Field(ge=10)] = 500
    """Windows per iteration."""
    window: AtOnce = 25
    """Steps per window."""
    outlier_share: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    """Fraction of the windows to leave out, those with the largest gaps; as in the authors' code."""
    shrink: Annotated[float, Field(gt=0, lt=1)] = 0.6
    """Factor on the ranges of the parameters that moved, applied after each iteration."""
    policy_at: Literal["point", "around"] = "point"
    """"point": train the policy at the identified parameters, as the authors do. "around": draw parameters
    from the final, narrowed ranges; parameters that were not identified keep their full ranges."""


def parameters_at(point: Mapping[str, float], kind: type[Variation]) -> Tensor:
    """Return parameters (P,) with the values in `point`, and otherwise those of the plain simulator."""
    return kind(**{name: (value, value) for name, value in point.items()}).ranges()[:, 0]


@dataclass
class Search:
    """The state of the identification.

    Attributes:
        box: ranges in which the parameters are searched. point: the best steering parameters so far.
        found: results of each finished iteration. spent: their time; None before the first.
    """

    box: Variation
    point: dict[str, float]
    found: list[dict[str, Any]]
    spent: dict[str, float] | None

    @classmethod
    def begin(cls, ranges: Variation, checkpoint: Path) -> "Search":
        """Resume from `checkpoint`; without one, start at the plain simulator, clipped to `ranges`."""
        if checkpoint.exists():
            with resumed(checkpoint) as (_, metadata):
                return cls(
                    Variation.of_json(metadata["box"]),
                    metadata["point"],
                    metadata["found"],
                    metadata["spent"],
                )
        plain = type(ranges)()
        point = {name: _within(getattr(plain, name)[0], getattr(ranges, name)) for name in ranges.steering}
        return cls(ranges, point, [], None)

    def save(self, checkpoint: Path) -> None:
        """Write the checkpoint that `begin` resumes from."""
        save_state(checkpoint, {"box": self.box.ranges()}, vars(self) | {"box": self.box.model_dump()})

    def narrow(self, names: Iterable[str], shrink: float) -> None:
        """Shrink the box around the point by the factor `shrink`, along the parameters in `names`."""
        box = self.box.model_dump()
        for name in names:
            reach = shrink * (box[name][1] - box[name][0]) / 2
            ends = self.point[name] - reach, self.point[name] + reach
            box[name] = tuple(_within(end, box[name]) for end in ends)
        self.box = type(self.box)(**box)


def _within(value: float, ends: tuple[float, float]) -> float:
    return min(max(value, ends[0]), ends[1])


def identify(fitting: Fitting) -> tuple[IdentifiedParameters, dict[str, Any]]:
    """Find the parameters with which replays come closest to the recorded episodes.

    Every iteration replays windows with parameters from a box, fits a causal model to the gaps, moves the
    parameters that matter to the predicted minimum, and shrinks the box around them.

    Returns:
        the parameters, and: the mask of the first iteration, the point, the mean gaps of held-out windows in
        the plain simulator and at the point (without noise), and the same of every iteration.

    Raises:
        BadInputError: no episode is as long as a window, or no steering parameter has a range.
    """
    wide = fitting.task.varied.wide
    config = own_settings(fitting.settings, CompassConfig(**wide.model_dump()))
    checkpoint = fitting.folder / CHECKPOINT
    ranges = config.of_kind(type(wide))
    if not set(ranges.steering).intersection(_varied(ranges)):
        raise BadInputError(f"[compass]: expected a range for at least one of {', '.join(ranges.steering)}")
    held_out = ReplayWindows.side_by_side(fitting.held_out, config.window)

    def held_out_gap(point: Mapping[str, float]) -> dict[str, float]:
        at = parameters_at(point, type(ranges)).unsqueeze(0).to(fitting.device)
        gaps = trajectory_gaps(fitting.task, held_out, at, fitting.seed)
        return dict(zip(fitting.task.quantities, gaps.mean((0, 1)).tolist(), strict=True))

    search, plain = Search.begin(ranges.replayed(), checkpoint), held_out_gap({})
    stopwatch, replays = Stopwatch(search.spent), config.contexts * config.windows
    first = next(iter(plain))
    for iteration in range(len(search.found), config.iterations):
        mask = _iterate(search, config, fitting, f"compass {iteration}")
        gap = held_out_gap(search.point)
        search.found.append({"mask": mask, "point": dict(search.point), "held_out_gap": gap})
        search.spent = stopwatch.spent()
        search.save(checkpoint)
        rate = (iteration + 1) * replays / stopwatch.seconds
        closed = f"held-out gap {plain[first]:.3f} → {gap[first]:.3f} {first}"
        note = f"{rate:,.0f} replays/s  {closed}"
        fitting.progress((iteration + 1) / config.iterations, note)
    found = {name: getattr(search.box, name) for name in ranges.steering}
    if config.policy_at == "point":
        found = {name: (value, value) for name, value in search.point.items()}
    return IdentifiedParameters(ranges.model_copy(update=found)), {
        "replays_per_second": config.iterations * replays / stopwatch.seconds,
        **stopwatch.spent(),
        "mask": search.found[0]["mask"],
        "point": search.point,
        "held_out_gap": {"plain": plain, "identified": search.found[-1]["held_out_gap"]},
        "iterations": search.found,
    }


def _varied(box: Variation) -> list[str]:
    return [name for name, (low, high) in box.model_dump().items() if low < high]


def _iterate(search: Search, config: CompassConfig, fitting: Fitting, name: str) -> Mask:
    """Do one iteration of `search`; return the parameters' mask."""
    device, box = fitting.device, search.box
    torch.manual_seed(derive(fitting.seed, f"{name} windows"))
    episode, first = beginnings(fitting.training, config.window)
    drawn = torch.randint(len(episode), (config.windows,), device=device)
    recorded = ReplayWindows.at(fitting.training, episode[drawn], first[drawn], config.window)
    contexts, noise = box.draw(config.contexts, device), derive(fitting.seed, f"{name} noise")
    gaps = trajectory_gaps(fitting.task, recorded, contexts, noise)
    of_window = gaps.mean(0)
    usual = (of_window <= of_window.quantile(1.0 - config.outlier_share, dim=0)).all(-1)
    # Gaps vary far more between windows than with parameters: learn the difference within a window.
    difference = (gaps - of_window)[:, usual]
    scale = difference.std((0, 1)).clamp_min(1e-9)
    varied = _varied(box)
    columns = [box.names.index(parameter) for parameter in varied]
    summary = recorded.summary(fitting.task)[usual]
    parameters = box.normal(contexts)[:, None, columns].expand(-1, len(summary), -1)
    cause = torch.cat([parameters, summary.expand(len(contexts), -1, -1)], dim=-1)
    effect = (difference / scale).flatten(0, 1)
    torch.manual_seed(derive(fitting.seed, f"{name} model"))
    model = fit_causes(cause.flatten(0, 1), effect, config, penalized=len(varied))
    mask = (model.probability > config.mask_threshold).float()
    steers = torch.tensor([parameter in box.steering for parameter in varied], device=device)
    moves = mask[: len(varied)].any(-1) & steers
    kind = type(box)
    here = box.normal(parameters_at(search.point, kind))[columns].to(device)
    there = descend(model, mask, here, moves, summary).cpu()
    low, high = box.ranges()[columns].unbind(-1)
    values = low + (there + 1.0) / 2.0 * (high - low)
    moved = {
        parameter: _within(value, getattr(box, parameter))
        for parameter, value, moving in zip(varied, values.tolist(), moves.tolist(), strict=True)
        if moving
    }
    points = (search.point, search.point | moved)
    both = torch.stack([parameters_at(point, kind) for point in points]).to(device)
    before, after = (trajectory_gaps(fitting.task, recorded, both, noise)[:, usual] / scale).mean((1, 2))
    # The model smooths over edges of the gap, so the step is accepted only if replays confirm it.
    if after < before:
        search.point |= moved
    search.narrow(moved, config.shrink)
    rows = (dict(zip(fitting.task.quantities, row, strict=True)) for row in model.probability.tolist())
    return dict(zip(varied, rows, strict=False))


TABLE = Table("compass", CompassConfig, ranges="wide")

COMPASS = Method(
    name="compass",
    title="COMPASS",
    color="#F0E442",
    fit=identify,
    table=TABLE,
    configures="ground",
)

COMPASS_UNIFORM = Method(
    name="compass_uniform",
    title="COMPASS, uniform",
    color="#B8A000",
    learn=InSimulator(ranges="wide"),
    table=TABLE,
)
"""COMPASS as the paper describes it: every episode draws its parameters from the ranges."""
