"""Align: fit the target encoder ψ^t to the frozen source encoder (paper, Section IV-B)."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, field_validator

from astra_data.core.artifact import CHECKPOINT, finished_folder
from astra_data.core.config import NotNegative, as_json
from astra_data.core.durable import file_digest
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.progress import Progress, silent
from astra_data.core.provenance import origin
from astra_data.core.seeding import derive
from astra_data.dataset.versions import open_dataset
from astra_data.grounding.descent import Descent, WindowedConfig
from astra_data.grounding.features import MADE_BY
from astra_data.grounding.files import GROUNDING, TARGET_ENCODER, load_history_model, save_target_encoder
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows
from astra_data.reports.artifacts import METRICS

if TYPE_CHECKING:
    from astra_data.grounding.alignment import TargetEncoder
    from astra_data.grounding.model import GroundingModel

_MEASURED_EVERY = 100
_BANDWIDTHS = (0.25, 0.5, 1.0, 2.0)  # of the MMD's kernels, in units of the square root of the latent's size


class AlignConfig(WindowedConfig):
    """How the target encoder is fitted."""

    paired_weight: NotNegative = 1.0
    """Weight of the squared distance of paired latents, beside the MMD; 0 gives the paper's loss."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Fraction of the episodes to hold out for measuring the agreement, unless the dataset holds some out
    itself. In a recipe this is that of `[ground]`, whose training leaves these episodes out."""
    inputs: tuple[str, ...] = ()
    """Columns that the target encoder reads in place of the state, such as "observation.features.front". It then also
    estimates the abstract state, so that the policy runs without tracking."""

    @field_validator("inputs")
    @classmethod
    def _are_observed(cls, inputs: tuple[str, ...]) -> tuple[str, ...]:
        if wrong := [name for name in inputs if not name.startswith("observation.")]:
            raise ValueError(f"expected columns of what is observed before the action, observation.…, got {wrong[0]}")
        return tuple(dict.fromkeys(inputs))


def align(
    config: AlignConfig = AlignConfig(),
    *,
    dataset: str | Path,
    grounding: Path,
    seed: int = 0,
    out: Path,
    device: str = "cpu",
    progress: Progress = silent,
) -> None:
    """Fit ψ^t on index-matched target and abstract histories; write it and its agreement with ψ^s to `out`.

    Raises:
        BadInputError: an input is missing or malformed, or `out` was begun with other settings.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import align, ground
        >>> from astra_data.grounding.fit import GroundConfig
        >>> from astra_data.pipeline.stages.align import AlignConfig
        >>> ground("antmaze-umaze", "astra", GroundConfig(updates=2), dataset="pairs", out=Path("astra"))
        >>> align(AlignConfig(updates=2), dataset="pairs", grounding=Path("astra"), out=Path("encoder"))
    """
    from astra_data.grounding.alignment import TargetEncoder, unit_vectors

    made = origin(device)
    grounding_file = grounding / GROUNDING
    model = load_history_model(grounding_file, device)
    episodes = PairedEpisodes.load(dataset, device, config.inputs)
    model.check(episodes)
    training, held_out = episodes.split(config.held_out_share, seed)
    torch.manual_seed(derive(seed, "alignment"))
    shape = model.shape
    alike = {name: getattr(shape, name) for name in ("embedding_size", "latent_size", "position_octaves", "encoder")}
    abstract = training.steps(training.windows.state) if config.inputs else None
    if abstract is not None:
        source = open_dataset(dataset)
        made_by = source.description["environment"].get(MADE_BY, {})
        sensing = {
            "inputs": {column.name: column.size for column in source.specs(config.inputs)},
            "pictures": {name: made_by[name] for name in config.inputs if name in made_by},
            "abstract_size": shape.state_size,
            "unit_vectors": unit_vectors(abstract),
        }
        alike |= {"position_octaves": 0, "sensing": sensing}
    encoder = TargetEncoder(episodes.target_state.shape[-1], shape.goal_size, shape.action_size, **alike).to(device)
    # Where φ drops the robot's place, latents must not depend on where it came from.
    state, goal = training.steps(training.target_state), training.steps(training.windows.goal)
    encoder.set_scales(state, goal, training.dropped_place, abstract)
    bandwidths = torch.tensor(_BANDWIDTHS, device=device) * shape.latent_size**0.5
    grounding_digest = file_digest(grounding_file)
    settings_text = as_json(**episodes.named, grounding_sha256=grounding_digest, seed=seed, align=config)
    made_from = {"dataset": episodes.content_hash, "grounding": grounding_digest}
    with finished_folder(out, config=settings_text, made_from=made_from) as folder:
        fitting = config.descent(int(training.lengths.sum()))
        descent = Descent(encoder, fitting, checkpoint=folder / CHECKPOINT)
        window = min(config.window, training.windows.mask.shape[1])
        while not descent.is_over:
            torch.manual_seed(derive(seed, f"alignment update {descent.done}"))
            windows, state = training.draw_windows(config.batch_windows, window)
            discrepancy, distance = _losses(model, encoder, windows, state, bandwidths)
            loss = discrepancy + config.paired_weight * distance
            descent.update(loss + _estimate_apart(encoder, windows, state).abs().mean() if config.inputs else loss)
            if descent.done % _MEASURED_EVERY == 0 or descent.done == fitting.updates:
                encoder.eval()  # a user's may have parts that only learning draws
                measured = _agreement(model, encoder, held_out, bandwidths)
                encoder.train()
                error = measured["mmd"] + config.paired_weight * measured["latent_rmse"] ** 2
                descent.keep(error + measured.get("estimate_error", 0.0), **measured)
                rate = descent.done * config.batch_windows / descent.stopwatch.seconds
                note = f"{rate:,.0f} windows/s  paired latent RMSE {measured['latent_rmse']:.3f}"
                progress(descent.share, note)
        descent.finish()
        agreement: dict[str, Any] = {**_agreement(model, encoder.eval(), held_out, bandwidths)}
        encoder.latent_r2.fill_(agreement["latent_r2"])
        save_target_encoder(folder / TARGET_ENCODER, encoder)
        if config.inputs:
            apart = _estimate_apart(encoder, held_out.windows, held_out.target_state)
            agreement |= {"estimate_rmse": (apart.square().mean(0).sqrt() * encoder.abstract_std).tolist()}
        metrics: dict[str, Any] = made | descent.stopwatch.spent() | {"points": descent.points} | agreement
        metrics["deployed"] = "target" if encoder.is_deployed else "source"
        (folder / METRICS).write_text(json.dumps(metrics, indent=1))


def _losses(
    model: "GroundingModel", encoder: "TargetEncoder", windows: PairedWindows, state: Tensor, bandwidths: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean MMD² between p^s_i and p^t_i, and the mean squared distance of paired latents."""
    from astra_data.grounding.alignment import gaussian_mmd

    with torch.no_grad():
        source, _ = model.encode(windows)
        source_mean, source_log_variance = model.predict_latent(source, windows.action)
    target, _ = encoder.encoder.sequence(encoder.encoder_input(state, windows.goal, windows.previous_action))
    mean, log_variance = model.predict_latent(target, windows.action)
    discrepancy = gaussian_mmd(source_mean, source_log_variance.exp(), mean, log_variance.exp(), bandwidths)
    distance = (target - source).square().mean(-1)
    total = windows.mask.sum()
    return (discrepancy * windows.mask).sum() / total, (distance * windows.mask).sum() / total


@without_gradients
def _agreement(
    model: "GroundingModel", encoder: "TargetEncoder", episodes: PairedEpisodes, bandwidths: Tensor
) -> dict[str, float]:
    discrepancy, distance = _losses(model, encoder, episodes.windows, episodes.target_state, bandwidths)
    latent, _ = model.encode(episodes.windows)
    variance = episodes.steps(latent).var(0, correction=0).mean()
    explained = 1.0 - distance / variance if variance > 0 else torch.zeros_like(distance)
    found = {"mmd": float(discrepancy), "latent_rmse": float(distance.sqrt()), "latent_r2": float(explained)}
    if encoder.inputs:
        found["estimate_error"] = float(_estimate_apart(encoder, episodes.windows, episodes.target_state).abs().mean())
    return found


def _estimate_apart(encoder: "TargetEncoder", windows: PairedWindows, state: Tensor) -> Tensor:
    """Return how far the estimated φ(s_i) of N real steps is off, (N, X), in units of its deviation.

    The mean of their sizes is what falls: squares would be those of what no camera sees.
    """
    read = encoder.encoder_input(state, windows.goal, windows.previous_action)
    _, memory = encoder.estimator.sequence(read)
    return ((encoder.estimates(read, memory) - windows.state) / encoder.abstract_std)[windows.mask.bool()]
