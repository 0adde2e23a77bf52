import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_joints import FPS, NAMES, piece, write_log

from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset
from astra_data.studies.errors import Starts
from astra_data.studies.joints import ALL, Joints, JointsConfig
from astra_data.studies.predictors import Response
from astra_data.studies.recordings import read_recordings
from astra_data.studies.rollouts import FitConfig, fit, predict
from astra_data.studies.sequences import Sequences, StepsConfig, Stretch

CONFIG = StepsConfig(rows=4, history=6)
QUICK = FitConfig(
    updates=120,
    batch=64,
    steps=8,
    learning_rate=1e-2,
    noise=0.0,
    start="ridge",
    latent_size=8,
    head_sizes=(16,),
    hidden_sizes=(16,),
)
SEQUENCES = Sequences.of_pieces([piece(1600, seed) for seed in range(2)], FPS, CONFIG)
TEST = Starts.of(Sequences.of_pieces([piece(1200, 7)], FPS, CONFIG), 6, (1, 10))


def error(name: str, config: FitConfig = QUICK) -> float:
    errors = TEST.squared_errors(fit(name, SEQUENCES, 6, config, 0, silent))
    return float(errors[:, 1, 0].nanmean().sqrt())


def exact(weights: tuple[float, float, float]) -> Stretch:
    """Return stretches of joints whose motion is what `Response` says, without noise."""
    joints = Joints.named(NAMES, has_targets=True)
    random = torch.Generator().manual_seed(0)
    target, before, seen = (torch.randn(200, 1, 3, generator=random) for _ in range(3))
    spring, rest, pull = weights
    motion = spring * (target - seen) + rest * before + pull
    return Stretch(
        past_motion=before,
        past_action=target - seen,
        past_seen=seen,
        past_simulated=before,
        action=target,
        simulated=target - seen,
        motion=motion,
        counts=torch.ones(200, 1, dtype=torch.bool),
        heading=torch.zeros(200),
        body=joints,
    )


def test_the_simulator_covers_a_share_of_the_way_to_the_target() -> None:
    late = Joints.named(("a", "b"), has_targets=True, time_constant_s=0.1).at(0.05)
    target, seen = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.5, 0.0]])
    away, motion = late.command(target, torch.zeros(1, 2), seen)
    torch.testing.assert_close(away, torch.tensor([[0.5, -1.0]]))
    torch.testing.assert_close(motion, away * (1 - math.exp(-0.5)))
    at_once = Joints.named(("a", "b"), has_targets=True).at(0.05)
    torch.testing.assert_close(seen + at_once.command(target, motion, seen)[1], target)


def test_without_targets_the_simulator_stands_still() -> None:
    joints = Joints.named(NAMES, has_targets=False)
    action, motion = joints.command(torch.empty(4, 0), torch.ones(4, 3), torch.ones(4, 3))
    assert action.shape == (4, 0) and not motion.any()


def test_steps_hold_mean_targets_and_the_change_of_position() -> None:
    toy = piece(40, 0)
    columns = toy.body.at(0.01).steps(toy.state, toy.action, 4, FPS)
    np.testing.assert_allclose(columns["action"][2], toy.action[8:12].mean(0), rtol=1e-6)
    np.testing.assert_allclose(columns["motion"][2], toy.state[12] - toy.state[8], atol=1e-6)
    np.testing.assert_allclose(columns["seen"][2], toy.state[8], rtol=1e-6)
    np.testing.assert_allclose(columns["simulated"][2], toy.action[8:12].mean(0) - toy.state[8], atol=1e-6)


def test_predictions_know_nothing_of_the_positions_to_come() -> None:
    """Commands of later steps are relative to where the joint was recorded; open loop it is elsewhere."""
    stretch = TEST.stretch
    model = fit("gains", SEQUENCES, 6, QUICK, 0, silent)
    found = predict(model, stretch)
    elsewhere = replace(stretch, motion=stretch.motion + 1, simulated=stretch.simulated + 1)
    torch.testing.assert_close(predict(model, elsewhere), found)
    assert isinstance(model, Response)
    # The second step by hand.
    spring, rest, pull = model.weights.unbind(-1)
    seen, before = stretch.past_seen[:, -1], stretch.past_motion[:, -1]
    for step in range(2):
        before = spring * (stretch.action[:, step] - seen) + rest * before + pull
        seen = seen + before
    torch.testing.assert_close(found[:, 1], seen - stretch.past_seen[:, -1], atol=1e-5, rtol=1e-4)


def test_the_response_that_joints_move_by_is_found() -> None:
    model = Response(3)
    model.fit(exact((0.3, 0.5, -0.02)))
    torch.testing.assert_close(model.weights, torch.tensor([[0.3, 0.5, -0.02]] * 3), atol=1e-4, rtol=0)


def test_the_error_of_all_joints_is_the_root_of_the_mean_square() -> None:
    joints = Joints.named(NAMES, has_targets=True)
    wrong = joints.wrong(torch.tensor([[[3.0, 0.0, 4.0]]]), torch.zeros(1, 1, 3), torch.zeros(1))
    torch.testing.assert_close(wrong[0, 0], torch.tensor([(25 / 3) ** 0.5, 3.0, 0.0, 4.0]))
    assert joints.axes == (ALL, *NAMES) and joints.judged == (ALL,)


def test_the_reward_is_how_much_nearer_the_targets_come() -> None:
    joints = Joints.named(("a", "b"), has_targets=True)
    given = torch.tensor([[[9.0, 9.0], [1.0, -2.0]]])
    motion = torch.tensor([[[0.0, 0.0], [0.5, -1.0]]])
    assert joints.nearer(given, given, motion).tolist() == [[0.75]]
    without = Joints.named(("a", "b"), has_targets=False)
    assert without.nearer(given, given[..., :0], motion).tolist() == [[0.0]]


def test_late_joints_are_better_predicted_by_their_past() -> None:
    raw, gains, ridge = map(error, ("raw", "gains", "ridge"))
    assert gains < 0.1 * raw
    assert ridge < 0.9 * gains


@pytest.mark.parametrize("name", ["mlp", "nas", "astra"])
def test_networks_begin_with_ridge_regression_and_learn_what_it_lacks(name: str) -> None:
    begun = FitConfig(**{**QUICK.model_dump(), "updates": 1, "learning_rate": 1e-12})
    assert error(name, begun) == pytest.approx(error("ridge"), rel=1e-3)
    assert error(name) < 0.995 * error("ridge")


@pytest.mark.parametrize("name", ["raw", "gains", "ridge", "mlp", "nas", "astra"])
def test_joints_without_targets_are_predicted_from_their_past(name: str) -> None:
    pieces = [piece(800, seed, has_targets=False) for seed in range(2)]
    sequences = Sequences.of_pieces(pieces, FPS, CONFIG)
    short = FitConfig(**{**QUICK.model_dump(), "updates": 2})
    errors = Starts.of(sequences, 6, (1,)).squared_errors(fit(name, sequences, 6, short, 0, silent))
    still = float(sequences.motion.square().mean())
    assert float(errors[..., 0].mean()) <= (1.05 if name == "raw" else 0.3) * still


def test_the_joints_are_those_of_the_state_and_each_has_a_target(tmp_path: Path) -> None:
    write_log(tmp_path / "log.pt", 1200, seed=0)
    mapping = tmp_path / "mapping.toml"
    text = 'name = "toy"\ntask = "t"\nfps = 400\n[columns."observation.state"]\nfields = ["dof_pos"]\n'

    def dataset(more: str, name: str) -> Dataset:
        mapping.write_text(text + more)
        return Dataset.open(import_dataset([tmp_path / "log.pt"], mapping, out=tmp_path / name).root)

    config = JointsConfig(time_constant_s=0.05)
    alone = config.body(dataset("", "alone"))
    assert (alone.motion_size, alone.given_size, alone.axes[1]) == (3, 0, "joint_1")
    both = config.body(dataset('[columns.action]\nfields = ["des_dof_pos"]\n', "both"))
    assert isinstance(both, Joints) and (both.given_size, both.time_constant_s) == (3, 0.05)
    fewer = dataset('[columns.action]\nfields = ["des_dof_pos"]\ntake = [0]\n', "fewer")
    with pytest.raises(BadInputError, match="action holds 1 values, expected a target for each of the 3"):
        config.body(fewer)


def test_a_single_joint_and_a_log_without_joints(tmp_path: Path) -> None:
    write_log(tmp_path / "log.pt", 1200, seed=0)
    mapping = tmp_path / "mapping.toml"
    head = 'name = "toy"\ntask = "t"\nfps = 400\n'
    mapping.write_text(f'{head}[columns."observation.state"]\nfields = ["dof_pos"]\ntake = [1]\n')
    [one] = read_recordings(tmp_path / "log.pt", mapping, tmp_path / "home", JointsConfig())
    assert one.pieces[0].state.shape == (len(one.pieces[0]) + 1, 1)
    found = Sequences.of_pieces(one.pieces, one.fps, CONFIG)
    assert found.motion.shape[-1] == 1
    mapping.write_text(f'{head}[columns.action]\nfields = ["des_dof_pos"]\n')
    with pytest.raises(BadInputError, match=r"expected joints in observation\.state, found no such column"):
        read_recordings(tmp_path / "log.pt", mapping, tmp_path / "home", JointsConfig())


def test_joints_that_respond_late_cover_the_share_of_a_control_step() -> None:
    """Not that of a row, nor of a second: 4 rows at 400 Hz are 10 ms, a tenth of the time constant."""
    slow = replace(piece(400, 0), body=Joints.named(NAMES, has_targets=True, time_constant_s=0.1))
    sequences = Sequences.of_pieces([slow], FPS, CONFIG)
    away = sequences.action - sequences.seen[:, :-1]
    torch.testing.assert_close(sequences.simulated[:, :99], (1 - math.exp(-0.1)) * away[:, :99])
