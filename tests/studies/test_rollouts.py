import pytest
import torch
from toy_walks import FPS, GAINS, piece

from astra_data.core.progress import silent
from astra_data.studies.errors import Starts
from astra_data.studies.motion import MIRROR
from astra_data.studies.predictors import Gains
from astra_data.studies.rollouts import FITS, FitConfig, fit, predict
from astra_data.studies.sequences import Sequences, StepsConfig

CONFIG = StepsConfig(rows=10, history=4)
QUICK = FitConfig(
    updates=60,
    batch=64,
    steps=4,
    learning_rate=5e-3,
    noise=0.0,
    latent_size=16,
    head_sizes=(16,),
    hidden_sizes=(32,),
)
TEST = Starts.of(Sequences.of_pieces([piece(900, 10)], FPS, CONFIG), 4, (1, 6))
SEQUENCES = Sequences.of_pieces([piece(1200, seed) for seed in range(2)], FPS, CONFIG)


def error(name: str) -> torch.Tensor:
    model = fit(name, SEQUENCES, 4, QUICK, 0, silent)
    return TEST.squared_errors(model)[:, 1, :3].nanmean(0).sqrt()


def test_the_raw_simulator_predicts_a_robot_that_follows_commands_at_once() -> None:
    sequences = Sequences.of_pieces([piece(300, 0, gains=(1.0, 1.0, 1.0), late_rows=0)], FPS, CONFIG)
    errors = Starts.of(sequences, 4, (1, 5)).squared_errors(Gains())
    assert errors.nan_to_num().max() < 1e-8


def test_gains_are_found() -> None:
    sequences = Sequences.of_pieces([piece(1200, 0, late_rows=0)], FPS, CONFIG)
    model = fit("gains", sequences, 4, QUICK, 0, silent)
    assert isinstance(model, Gains)
    # The toy scales what the simulator does in a row, in which an arc is nearly straight.
    torch.testing.assert_close(model.gains, torch.tensor(GAINS), atol=0.02, rtol=0)


def test_a_late_robot_is_better_predicted_by_its_past() -> None:
    raw, gains, ridge = map(error, ("raw", "gains", "ridge"))
    assert (gains < raw).all()
    assert (ridge < 0.35 * gains).all()


def test_a_ridge_of_too_little_to_choose_from_is_fitted_all_the_same() -> None:
    """Of one start in the last quarter nothing can be compared; no warning says so."""
    short = Sequences.of_pieces([piece(120, 0)], FPS, CONFIG)
    assert torch.isfinite(TEST.squared_errors(fit("ridge", short, 4, QUICK, 0, silent))[:, 0]).any()


@pytest.mark.parametrize("name", ["mlp", "nas", "astra"])
def test_networks_learn_that_the_robot_is_late(name: str) -> None:
    # Unfitted, they are the raw simulator, which is worse than it with gains.
    assert (error(name) < error("gains")).all()


@pytest.mark.parametrize("name", sorted(FITS))
def test_left_and_right_are_alike(name: str) -> None:
    short = FitConfig(**{**QUICK.model_dump(), "updates": 3})
    model = fit(name, SEQUENCES, 4, short, 0, silent)
    stretch = TEST.stretch
    torch.testing.assert_close(
        predict(model, stretch) * torch.tensor(MIRROR), predict(model, stretch.mirrored()), atol=1e-5, rtol=0
    )


def test_one_seed_gives_one_model() -> None:
    short = FitConfig(**{**QUICK.model_dump(), "updates": 5})
    first, second = (fit("astra", SEQUENCES, 4, short, 1, silent).state_dict() for _ in range(2))
    assert all(torch.equal(first[key], second[key]) for key in first)
