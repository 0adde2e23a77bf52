import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_run import ALIGN
from stopping import Stopped, stop_past
from toy_episodes import no_episodes

from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ABSTRACT_STATE, STATE, Column
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import next_version
from astra_data.grounding.alignment import TargetEncoder, gaussian_mmd, unit_vectors
from astra_data.grounding.files import load_history_model, load_target_encoder, save_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.pipeline.stages.align import AlignConfig, align


def test_the_target_encoder_comes_closer_to_the_source(aligned: Path, grounded: Path) -> None:
    assert {file.name for file in aligned.iterdir()} == {
        "config.json",
        "manifest.json",
        "metrics.json",
        "target_encoder.safetensors",
    }
    told = json.loads((aligned / "config.json").read_text())
    assert told["grounding_sha256"] == file_digest(grounded / "grounding.safetensors")
    metrics = json.loads((aligned / "metrics.json").read_text())
    assert {"git_commit", "packages", "machine"} <= metrics.keys()
    first, last = metrics["points"]
    assert (first["step"], last["step"]) == (100, 200) and 0 < last["held_out_error"] < first["held_out_error"]
    for point in (first, last):
        assert point["held_out_error"] == pytest.approx(point["mmd"] + point["latent_rmse"] ** 2)
    assert last["mmd"] == metrics["mmd"]
    encoder = load_target_encoder(aligned / "target_encoder.safetensors")
    assert encoder.encoder.latent_size == 16 and float(encoder.latent_r2) == pytest.approx(metrics["latent_r2"])
    assert metrics["deployed"] == ("target" if metrics["latent_r2"] >= 0.9 else "source")


def test_the_weights_with_the_least_held_out_error_are_kept(
    paired: Path, grounded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors, seen = iter((1.0, 2.0, 3.0)), list[dict[str, torch.Tensor]]()

    def measured(_: object, encoder: TargetEncoder, *__: object) -> dict[str, float]:
        assert not encoder.training
        seen.append({name: values.clone() for name, values in encoder.encoder.state_dict().items()})
        return {"mmd": next(errors), "latent_rmse": 0.0, "latent_r2": 0.5}

    monkeypatch.setattr("astra_data.pipeline.stages.align._agreement", measured)
    align(ALIGN, dataset=paired, grounding=grounded, out=tmp_path / "aligned")
    kept = load_target_encoder(tmp_path / "aligned/target_encoder.safetensors").encoder.state_dict()
    first, second, last = (all(torch.equal(kept[name], one[name]) for name in kept) for one in seen)
    assert first and not second and last


def test_the_agreement_is_that_of_held_out_episodes_alone(paired: Path, grounded: Path, aligned: Path) -> None:
    model = load_history_model(grounded / "grounding.safetensors")
    encoder = load_target_encoder(aligned / "target_encoder.safetensors")
    _, held_out = PairedEpisodes.load(paired).split(ALIGN.held_out_share, 0)
    windows, squares, discrepancies, latents = held_out.windows, [], [], []
    bandwidths = 4.0 * torch.tensor((0.25, 0.5, 1.0, 2.0))  # of 16 latents
    for row, length in enumerate(held_out.lengths.tolist()):
        steps = slice(row, row + 1), slice(0, length)
        history = [windows.goal[steps], windows.previous_action[steps]]
        source, _ = model.encoder.sequence(model.encoder_input(windows.state[steps], *history))
        target, _ = encoder.encoder.sequence(encoder.encoder_input(held_out.target_state[steps], *history))
        latents.append(source[0])
        squares.append((target - source).square().flatten())
        (mean, log_variance), (other, other_log_variance) = (
            model.predict_latent(latent, windows.action[steps]) for latent in (source, target)
        )
        apart = gaussian_mmd(mean, log_variance.exp(), other, other_log_variance.exp(), bandwidths)
        discrepancies.append(apart.flatten())
    metrics = json.loads((aligned / "metrics.json").read_text())
    assert metrics["latent_rmse"] == pytest.approx(float(torch.cat(squares).mean().sqrt()), rel=1e-4)
    unexplained = torch.cat(squares).mean() / torch.cat(latents).var(0, correction=0).mean()
    assert metrics["latent_r2"] == pytest.approx(1 - float(unexplained), abs=1e-3)
    assert metrics["mmd"] == pytest.approx(float(torch.cat(discrepancies).mean()), rel=1e-3)


def test_states_are_scaled_by_training_episodes_alone(paired: Path, aligned: Path) -> None:
    _, held_out = PairedEpisodes.load(paired).split(ALIGN.held_out_share, 0)
    states = [episode.columns[STATE] for episode in Dataset.open(paired).episodes([STATE])]
    known = [held_out.target_state[row, :length].numpy() for row, length in enumerate(held_out.lengths)]
    training = [values for values in states if not any(np.array_equal(values, other) for other in known)]
    assert len(training) == len(states) - len(held_out)
    encoder = load_target_encoder(aligned / "target_encoder.safetensors")
    values = np.concatenate(training).astype(np.float64)
    np.testing.assert_allclose(encoder.state_mean.numpy(), values.mean(0), atol=1e-4)
    np.testing.assert_allclose(encoder.state_std.numpy(), values.std(0, ddof=1).clip(1e-3), rtol=1e-3, atol=1e-5)


def test_the_paired_weight_adds_the_distance_of_paired_latents(paired: Path, grounded: Path, tmp_path: Path) -> None:
    """It is far larger than the discrepancy here, so that a few updates with it come closer."""
    distances = []
    for weight in (0.0, 100.0):
        out = tmp_path / str(weight)
        config = ALIGN.model_copy(update={"updates": 10, "paired_weight": weight})
        align(config, dataset=paired, grounding=grounded, out=out)
        distances.append(json.loads((out / "metrics.json").read_text())["latent_rmse"])
    assert distances[1] < distances[0]


@pytest.mark.parametrize(("latent_r2", "deployed"), [(0.899, False), (0.9, True)])
def test_a_coarse_encoder_is_not_deployed(latent_r2: float, deployed: bool) -> None:
    encoder = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8)
    assert not encoder.is_deployed  # before it was measured
    encoder.latent_r2.fill_(latent_r2)
    assert encoder.is_deployed == deployed


def test_where_phi_drops_the_place_the_encoder_does_not_see_it(
    paired: Path, grounded: Path, aligned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = PairedEpisodes.load(paired)
    placeless = replace(whole, dropped_place=(0, 1))
    monkeypatch.setattr(PairedEpisodes, "load", lambda *_: placeless)
    config, out = ALIGN.model_copy(update={"updates": 1}), tmp_path / "align"
    align(config, dataset=paired, grounding=grounded, out=out)
    scale = load_target_encoder(out / "target_encoder.safetensors").state_std
    assert scale[:2].isinf().all()
    torch.testing.assert_close(scale[2:], load_target_encoder(aligned / "target_encoder.safetensors").state_std[2:])


def test_after_an_interruption_it_goes_on(paired: Path, grounded: Path, aligned: Path, tmp_path: Path) -> None:
    out = tmp_path / "interrupted"
    begin = partial(align, ALIGN, dataset=paired, grounding=grounded, out=out)
    with pytest.raises(Stopped):
        begin(progress=stop_past(0.0))
    assert not out.exists()
    seen: list[float] = []
    begin(progress=lambda done, note: seen.append(done))
    assert seen == [1.0]
    name = "target_encoder.safetensors"
    assert (out / name).read_bytes() == (aligned / name).read_bytes()
    told, expected = (json.loads((folder / "metrics.json").read_text()) for folder in (out, aligned))
    assert told["points"] == expected["points"]


def test_the_encoder_is_as_large_as_the_source_and_sees_as_many_waves(paired: Path, tmp_path: Path) -> None:
    shape = GroundingShape(4, 2, 2, latent_size=8, embedding_size=24, position_octaves=1)
    made = HistoryGrounding(GroundingModel(shape))
    save_grounding(tmp_path / "grounding.safetensors", made, no_episodes())
    config = ALIGN.model_copy(update={"updates": 1})
    align(config, dataset=paired, grounding=tmp_path, out=tmp_path / "out")
    sizes = load_target_encoder(tmp_path / "out/target_encoder.safetensors").sizes
    assert (sizes["latent_size"], sizes["embedding_size"], sizes["position_octaves"]) == (8, 24, 1)


SEEN = "observation.features.front"


@pytest.fixture(scope="module")
def seen(paired: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pairs, with φ of the states, twice as large, as features of a camera, beside one that says nothing."""
    source, made_by = Dataset.open(paired), {SEEN: {"camera": "observation.images.front", "encoder": "eyes.py:EYES"}}
    environment = source.description["environment"] | {"features": made_by}
    options: dict[str, Any] = {"stage": "features", "config": {}, "out": tmp_path_factory.mktemp("seen") / "pairs"}
    with next_version(source, "columns", more=[Column(SEEN, size=5)], environment=environment, **options) as writer:
        for episode in source.episodes():
            noise = np.random.default_rng(episode.uid).normal(size=(len(episode), 1))
            values = np.concatenate([2 * episode.columns[ABSTRACT_STATE], noise], axis=1).astype(np.float32)
            writer.add(replace(episode, columns={**episode.columns, SEEN: values}))
    return writer.root


def test_inputs_are_read_in_place_of_states_and_phi_is_estimated_from_them(
    seen: Path, paired: Path, grounded: Path, tmp_path: Path
) -> None:
    config = ALIGN.model_copy(update={"inputs": (SEEN,)})
    align(config, dataset=seen, grounding=grounded, out=tmp_path / "out")
    encoder = load_target_encoder(tmp_path / "out/target_encoder.safetensors")
    assert encoder.inputs == {SEEN: 5} and encoder.pictures[SEEN]["encoder"] == "eyes.py:EYES"
    windows = PairedEpisodes.load(paired).split(ALIGN.held_out_share, 0)[1].windows
    noise = PairedEpisodes.load(seen, inputs=[SEEN]).split(ALIGN.held_out_share, 0)[1].target_state[..., 4:]
    read = encoder.encoder_input(torch.cat([2 * windows.state, noise], -1), windows.goal, windows.previous_action)
    apart = (encoder.estimates(read, encoder.estimator.sequence(read)[1]) - windows.state)[windows.mask.bool()]
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["estimate_rmse"] == pytest.approx(apart.square().mean(0).sqrt().tolist(), rel=1e-3)
    error = float((apart / encoder.abstract_std).abs().mean())
    assert metrics["estimate_error"] == pytest.approx(error, rel=1e-3) and error < 0.5  # after few updates
    first = metrics["points"][0]
    expected = first["mmd"] + first["latent_rmse"] ** 2 + first["estimate_error"]
    assert first["held_out_error"] == pytest.approx(expected)


def test_a_column_of_other_values_gives_another_encoder(seen: Path, grounded: Path, tmp_path: Path) -> None:
    whole, both = PairedEpisodes.load(seen), PairedEpisodes.load(seen, inputs=[SEEN, STATE])
    assert torch.equal(both.target_state[..., 5:], whole.target_state)
    assert torch.equal(both.windows.state, whole.windows.state)
    config, made = ALIGN.model_copy(update={"updates": 3, "inputs": (SEEN,)}), list[bytes]()
    for order in ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4], [1, 0, 2, 3, 4]):
        with pytest.MonkeyPatch.context() as patch:
            episodes = PairedEpisodes.load(seen, inputs=[SEEN])
            other = replace(episodes, target_state=episodes.target_state[..., order])
            patch.setattr(PairedEpisodes, "load", lambda *_, other=other: other)
            align(config, dataset=seen, grounding=grounded, out=tmp_path / str(len(made)))
        made.append((tmp_path / f"{len(made)}/target_encoder.safetensors").read_bytes())
    assert made[0] == made[1] != made[2]


def test_estimated_vectors_of_length_1_have_it() -> None:
    angle = torch.linspace(0, 6, 50)
    abstract = torch.stack([angle, angle.cos(), angle.sin(), angle + 1, 0.9 * angle.cos()], dim=1)
    turn = torch.nn.functional.normalize(torch.randn(50, 4), dim=1)
    assert unit_vectors(abstract) == [(1, 3)] and unit_vectors(torch.cat([abstract[:, :1], turn], 1)) == [(1, 5)]
    sensing = {"inputs": {"observation.a": 3}, "pictures": {}, "abstract_size": 5, "unit_vectors": [(1, 3)]}
    encoder = TargetEncoder(3, 0, 1, embedding_size=4, latent_size=4, sensing=sensing)
    encoder.set_scales(torch.randn(50, 3), torch.empty(50, 0), abstract=abstract)
    torch.nn.init.normal_(encoder.estimate_now.weight)
    read, memory = torch.randn(7, encoder.estimate_now.in_features), torch.randn(7, 4)
    normal = encoder.estimate_head(encoder.estimator.latent(memory)) + encoder.estimate_now(read)
    expected = abstract.mean(0) + abstract.std(0) * normal
    expected[:, 1:3] /= expected[:, 1:3].norm(dim=1, keepdim=True)
    torch.testing.assert_close(encoder.estimates(read, memory), expected)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (["observation.joints"], "has no column observation.joints; it has"),
        (["next.reward"], "expected columns of what is observed before the action, observation.…, got next.reward"),
    ],
)
def test_inputs_that_are_not_there_or_not_observed_are_refused(
    inputs: list[str], message: str, seen: Path, grounded: Path, tmp_path: Path
) -> None:
    with pytest.raises((BadInputError, ValueError), match=message):
        align(AlignConfig(inputs=tuple(inputs)), dataset=seen, grounding=grounded, out=tmp_path / "out")
