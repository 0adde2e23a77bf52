from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from toy_walks import FPS, piece

from astra_data.core.errors import BadInputError
from astra_data.studies.motion import composed
from astra_data.studies.sequences import Sequences, StepsConfig

CONFIG = StepsConfig(rows=10, history=4)
FAITHFUL = {"gains": (1.0, 1.0, 1.0), "late_rows": 0}


def test_a_robot_that_follows_commands_at_once_moves_like_the_simulator() -> None:
    sequences = Sequences.of_pieces([piece(207, 0, **FAITHFUL)], FPS, CONFIG)
    assert sequences.lengths.tolist() == [20] * 8 + [19] * 2
    real = torch.arange(20) < sequences.lengths[:, None]
    torch.testing.assert_close(sequences.motion[real], sequences.simulated[real], atol=1e-5, rtol=0)
    assert (sequences.counts == real).all()


def test_the_walk_of_a_moved_robot_is_the_same() -> None:
    here = piece(150, 1)
    frame = torch.tensor([[2.0, -3.0, 1.1]], dtype=torch.float64)
    moved = composed(frame, torch.from_numpy(here.state[:, :3]))
    ball = np.tile(composed(frame, torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64))[0, :2], (151, 1))
    there = replace(here, state=np.concatenate([moved.numpy(), ball], axis=1))
    one, other = (Sequences.of_pieces([walk], FPS, CONFIG) for walk in (here, there))
    for name in ("motion", "simulated", "action", "seen"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-5, rtol=0)


def test_histories_hold_the_simulators_motion_where_there_was_no_walking() -> None:
    walk = piece(200, 2)
    walk.broken[55] = True
    sequences = Sequences.of_pieces([walk], FPS, CONFIG)
    stretch = sequences.stretches(torch.tensor([0]), torch.tensor([7]), 4, 3)
    torch.testing.assert_close(stretch.past_motion[0, 2], sequences.simulated[0, 5])
    torch.testing.assert_close(stretch.past_motion[0, 3], sequences.motion[0, 6])
    assert not torch.equal(sequences.motion[0, 5], sequences.simulated[0, 5])
    sequence, step = sequences.starts(4, 3)
    first = step[sequence == 0]
    assert first.tolist() == [*range(6, 18)]
    # A sequence that begins six rows later has the jump one step earlier.
    assert sequences.counts[6].nonzero()[:5, 0].tolist() == [0, 1, 2, 3, 5]


def test_the_mirror_image_of_the_mirror_image_is_the_stretch() -> None:
    sequences = Sequences.of_pieces([piece(300, 3)], FPS, CONFIG)
    stretch = sequences.stretches(*sequences.starts(4, 5), 4, 5)
    mirrored = stretch.mirrored()
    assert not torch.equal(mirrored.motion, stretch.motion)
    columns = [field for field in fields(stretch) if field.name != "body"]
    for field in columns:
        assert torch.equal(getattr(mirrored.mirrored(), field.name), getattr(stretch, field.name))
    half = stretch.mirrored(torch.arange(len(stretch)) % 2 == 0)
    assert torch.equal(half.action[::2], mirrored.action[::2])
    assert torch.equal(half.action[1::2], stretch.action[1::2])


def test_pieces_that_are_too_short_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"more than 0\.8 s"):
        Sequences.of_pieces([piece(49, 0)], FPS, CONFIG)
