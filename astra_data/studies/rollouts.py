"""Open-loop prediction of recordings, and fitting models to it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from astra_data.core.config import AtOnce, Count, NotNegative, Positive
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.grounding.descent import Descent, DescentConfig
from astra_data.grounding.model import LossWeights
from astra_data.studies.histories import HistoryModel
from astra_data.studies.joints import Joints
from astra_data.studies.predictors import Gains, Predictor, Response
from astra_data.studies.sequences import Sequences, Stretch
from astra_data.studies.windows import WindowModel

STRENGTHS = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Penalties of ridge regression, of which the best is chosen."""
_LEAST = 1e-3
"""Least spread that errors are divided by, in the unit of motions: a joint that stands is not all."""


class FitConfig(DescentConfig):
    """Settings of fitting, the same for all models with gradients."""

    updates: Count = 400
    """Gradient updates in total."""
    batch: AtOnce = 64
    """Stretches per update."""
    steps: Count = 6
    """Steps of an open-loop prediction during fitting."""
    learning_rate: Positive = 2e-3
    """Initial learning rate; decays to zero along a half cosine."""
    weight_decay: NotNegative = 0.01
    """Weight decay of AdamW."""
    noise: NotNegative = 1.0
    """Standard deviation of noise on the history, in units of `Body.noise`, against overfitting."""
    start: Literal["simulator", "ridge"] = "simulator"
    """What networks correct: the motion predicted by the raw simulator, or by ridge regression."""
    latent_size: AtOnce = 64
    """Z of ASTRA and NAS."""
    head_sizes: tuple[AtOnce, ...] = (64, 64)
    """Hidden layers of their heads."""
    hidden_sizes: tuple[AtOnce, ...] = (128, 64)
    """Hidden layers of the feed-forward network."""


def predict(model: Predictor, stretch: Stretch) -> Tensor:
    """Return the predicted cumulative motions after each future step, (B, F, M).

    Of a walk, the mean of the prediction and of the mirrored prediction for the mirror image, so that it is
    symmetric.
    """
    if not stretch.body.mirror:
        return rollout(model, stretch)
    signs = stretch.motion.new_tensor(stretch.body.mirror["motion"])
    both = torch.stack([rollout(model, stretch), rollout(model, stretch.mirrored()) * signs])
    return both.mean(0)


def rollout(model: Predictor, stretch: Stretch) -> Tensor:
    """Return the cumulative motions (B, F, M) after each future step, predicted from the one before."""
    body, memory, seen = stretch.body, model.begin(stretch), stretch.past_seen[:, -1]
    place = torch.zeros_like(stretch.motion[:, 0])
    places = []
    for recorded, replayed in zip(stretch.action.unbind(1), stretch.simulated.unbind(1), strict=True):
        action, simulated = body.command(recorded, replayed, seen)
        motion = model.motion(memory, seen, action, simulated)
        place, seen = body.composed(place, motion), body.seen_after(seen, motion)
        memory = model.after(memory, motion, seen, action)
        places.append(place)
    return torch.stack(places, dim=1)


def fit(
    name: str, sequences: Sequences, history: int, config: FitConfig, seed: int, progress: Progress
) -> Predictor:
    """Fit the model `name` of `FITS` to `sequences`, with a history of `history` steps.

    Raises:
        BadInputError: there are too few steps that count.
    """
    torch.manual_seed(derive(seed, f"walk model {name}"))
    return FITS[name](sequences, history, config, progress)


def _raw(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> Predictor:
    return Gains(sequences.body.motion_size)


def _gains(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> Predictor:
    model = Response(sequences.body.motion_size) if isinstance(sequences.body, Joints) else Gains()
    model.fit(_sample(sequences, history, config.steps))
    return model


def _ridge(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> WindowModel:
    """Solve ridge regression with the penalty that is best on the last quarter of each sequence."""
    sequence, step = _starts(sequences, history, 1)
    is_late = step > 0.75 * sequences.lengths[sequence]
    everything, early = (
        sequences.stretches(sequence[chosen], step[chosen], history, 1)
        for chosen in (torch.ones_like(is_late), ~is_late)
    )
    late_sequence, late_step = sequences.starts(history, config.steps)
    is_late = late_step > 0.75 * sequences.lengths[late_sequence]
    test = sequences.stretches(late_sequence[is_late], late_step[is_late], history, config.steps)
    end = sequences.body.chained(test.motion)[:, -1]
    can_choose = len(early) > 0 and len(test) > 1
    spread = end.std(0).clamp_min(_LEAST) if can_choose else torch.ones(())

    def error(strength: float) -> float:
        model.solve(early, strength)
        return float(((predict(model, test)[:, -1] - end) / spread).square().mean())

    model = WindowModel(history, sequences.body).requires_grad_(False)
    model.set_scales(everything)
    model.solve(everything, min(STRENGTHS, key=error) if can_choose else STRENGTHS[-1])
    return model


def _mlp(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> Predictor:
    model = WindowModel(
        history, sequences.body, config.hidden_sizes, _base(sequences, history, config, progress)
    )
    model.set_scales(_sample(sequences, history, 1))
    return _descend(model, lambda stretch: torch.zeros(()), sequences, history, config, progress)


def _base(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> WindowModel | None:
    return _ridge(sequences, history, config, progress) if config.start == "ridge" else None


def _history_model(weights: LossWeights) -> Callable[[Sequences, int, FitConfig, Progress], Predictor]:
    def fitted(sequences: Sequences, history: int, config: FitConfig, progress: Progress) -> Predictor:
        base = _base(sequences, history, config, progress)
        model = HistoryModel(config.latent_size, config.head_sizes, weights, sequences.body, base)
        model.set_scales(_sample(sequences, history, 1))
        return _descend(model, model.loss, sequences, history, config, progress)

    return fitted


FITS: dict[str, Callable[[Sequences, int, FitConfig, Progress], Predictor]] = {
    "raw": _raw,
    "gains": _gains,
    "ridge": _ridge,
    "mlp": _mlp,
    "nas": _history_model(LossWeights(0.0, 0.0, 1.0)),
    "astra": _history_model(LossWeights(0.1, 1.0, 1.0)),
}
"""Name → fitting of the model to sequences. λ of ASTRA as in the maze recipes."""

_SAMPLE = 20_000


def _sample(sequences: Sequences, history: int, steps: int) -> Stretch:
    """Return at most `_SAMPLE` stretches with `steps` steps that count, evenly spaced over all."""
    sequence, step = _starts(sequences, history, steps)
    chosen = torch.linspace(0, len(sequence) - 1, min(len(sequence), _SAMPLE)).long()
    return sequences.stretches(sequence[chosen], step[chosen], history, steps)


def _starts(sequences: Sequences, history: int, steps: int) -> tuple[Tensor, Tensor]:
    """Return the starts of stretches to fit to, as `Sequences.starts` does.

    Raises:
        BadInputError: there are fewer than two.
    """
    sequence, step = sequences.starts(history, steps)
    if len(sequence) < 2:
        raise BadInputError(
            f"expected stretches of {history} + {steps} steps to fit to, the last of which count, found "
            f"{len(sequence)} in pieces of {int(sequences.lengths.max())} steps or fewer: give the recipe a "
            "larger piece_s, or less history, or take longer recordings"
        )
    return sequence, step


def _descend[M: (WindowModel, HistoryModel)](
    model: M,
    own_loss: Callable[[Stretch], Tensor],
    sequences: Sequences,
    history: int,
    config: FitConfig,
    progress: Progress,
) -> M:
    """Fit by gradients: open-loop errors after 1, 2, ... steps in units of their spread, plus `own_loss`."""
    chained = sequences.body.chained
    spread = chained(_sample(sequences, history, config.steps).motion).std(0).clamp_min(_LEAST)
    sequence, step = sequences.starts(history, 1)
    descent = Descent(model, config, weight_decay=config.weight_decay)
    while not descent.is_over:
        chosen = torch.randint(len(sequence), (config.batch,))
        stretch = sequences.stretches(sequence[chosen], step[chosen], history, config.steps)
        stretch = stretch.mirrored(torch.rand(config.batch) < 0.5)
        # Errors after a jump within a stretch are undefined.
        judged = stretch.all_count[..., None].expand_as(stretch.motion)
        error = (rollout(model, _noisy(stretch, config.noise)) - chained(stretch.motion)) / spread
        missed = error[judged].square().mean()
        descent.update(missed + own_loss(stretch))
        if isinstance(model, HistoryModel):
            model.grounding.update_target()
        if descent.done % 20 == 0:
            progress(descent.share, f"error² {float(missed.detach()):.3f}")
    return model.requires_grad_(False)


def _noisy(stretch: Stretch, size: float) -> Stretch:
    motion, seen = (stretch.motion.new_tensor(scale) * size for scale in stretch.body.noise)
    return replace(
        stretch,
        past_motion=stretch.past_motion + motion * torch.randn_like(stretch.past_motion),
        past_seen=stretch.past_seen + seen * torch.randn_like(stretch.past_seen),
    )
