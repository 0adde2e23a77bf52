import json

import numpy as np
import pytest
import torch
from toy_walks import FPS, piece

from astra_data.core.errors import BadInputError
from astra_data.studies.errors import Starts, summary
from astra_data.studies.predictors import Gains
from astra_data.studies.sequences import Sequences, StepsConfig
from astra_data.studies.walking import AXES

CONFIG = StepsConfig(rows=10, history=4)


def test_errors_are_taken_in_the_bodys_and_the_fields_frame() -> None:
    walk = piece(400, 0)
    walk.broken[200] = True
    starts = Starts.of(Sequences.of_pieces([walk], FPS, CONFIG), 4, (1, 3))
    errors = starts.squared_errors(Gains()).double()
    assert errors.shape[1:] == (2, 5)
    torch.testing.assert_close(errors[..., :2].sum(-1), errors[..., 3:].sum(-1), equal_nan=True)
    # A start one or two steps before the jump is judged after one step only.
    assert not errors[:, 0].isnan().any()
    assert errors[:, 1].isnan().all(-1).sum() >= 20


def test_of_too_many_starts_an_even_share_of_all_pieces_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    sequences = Sequences.of_pieces([piece(400, seed) for seed in range(3)], FPS, CONFIG)
    every = Starts.of(sequences, 4, (1,))
    assert len(every.piece) > 300
    monkeypatch.setattr("astra_data.studies.errors.MOST_STARTS", 30)
    some = Starts.of(sequences, 4, (1,))
    assert len(some.piece) == 30 and np.bincount(some.piece).min() >= 9


def test_horizons_that_no_recording_reaches_are_left_out() -> None:
    """120 rows are 12 steps, of which 4 are the history."""
    sequences = Sequences.of_pieces([piece(120, 0)], FPS, CONFIG)
    starts = Starts.of(sequences, 4, (1, 3, 8, 9, 40))
    assert starts.horizons == (1, 3, 8)
    assert starts.squared_errors(Gains()).isfinite().any(0).all()
    with pytest.raises(BadInputError, match="expected 20 control steps that count"):
        Starts.of(sequences, 4, (20, 40))


def test_summaries_weigh_starts_and_compare_with_the_raw_simulator() -> None:
    piece_of = np.array([0, 0, 0, 1])
    ones = np.ones((1, 4, 1, len(AXES)))
    uneven = ones.copy()
    uneven[0, 3] = np.nan
    models = summary(
        {"raw": 4 * ones, "ridge": ones, "astra": np.concatenate([ones, 0 * ones])}, piece_of, [1.0]
    )
    cell = models["astra"]["1"]["left_m"]
    assert cell["rmse"] == pytest.approx(0.5**0.5, abs=1e-5)
    assert cell["low"] == cell["high"] == pytest.approx(0.5**0.5, abs=1e-5)
    assert cell["less_than_raw"] == pytest.approx(1 - 0.5**0.5 / 2, abs=1e-5)
    assert models["ridge"]["1"]["mean"]["less_than_raw"] == pytest.approx(0.5)
    assert models["astra"]["1"]["mean"]["less_than_ridge"] == pytest.approx(1 - 0.5**0.5, abs=1e-5)
    alone = summary({"raw": uneven}, piece_of, [1.0])["raw"]["1"]["turn_rad"]
    assert alone["rmse"] == pytest.approx(1.0)


def test_intervals_resample_pieces() -> None:
    piece_of = np.repeat([0, 1], 100)
    squared = np.where(piece_of == 0, 1.0, 9.0)[None, :, None, None] * np.ones((1, 200, 1, len(AXES)))
    cell = summary({"raw": squared}, piece_of, [1.0])["raw"]["1"]["forward_m"]
    assert (cell["rmse"], cell["low"], cell["high"]) == pytest.approx((5**0.5, 1.0, 3.0), abs=1e-5)


def test_an_axis_at_rest_in_some_resamples_is_compared_by_the_others() -> None:
    piece_of = np.repeat(np.arange(3), 10)
    raw = np.ones((1, 30, 1, len(AXES)))
    raw[0, piece_of > 0, 0, 0] = 0.0  # one resample in nine takes piece 1 or 2 alone
    cell = summary({"raw": raw, "nas": raw / 4}, piece_of, [1.0])["nas"]["1"]
    for axis in ("forward_m", "mean"):
        assert cell[axis]["less_than_raw"] == cell[axis]["less_than_raw_low"] == pytest.approx(0.5)
        assert cell[axis]["less_than_raw_high"] == pytest.approx(0.5)


def test_intervals_hold_95_percent_of_the_resamples() -> None:
    """By another bootstrap; a 90 % interval would be a sixth narrower."""
    rng = np.random.default_rng(5)
    squared_of, starts_of = rng.uniform(0, 9, 40), rng.integers(1, 6, 40)
    piece_of = np.repeat(np.arange(40), starts_of)
    squared = np.repeat(squared_of, starts_of)[None, :, None, None] * np.ones((1, 1, 1, len(AXES)))
    cell = summary({"raw": squared}, piece_of, [1.0])["raw"]["1"]["forward_m"]
    drawn = rng.integers(40, size=(20_000, 40))
    errors = np.sqrt((squared_of * starts_of)[drawn].sum(1) / starts_of[drawn].sum(1))
    low, high = np.percentile(errors, [2.5, 97.5])
    assert [cell["low"], cell["high"]] == pytest.approx([low, high], abs=0.05 * (high - low))


def test_what_is_not_known_of_an_axis_that_never_moves_is_null_as_json_has_no_nan() -> None:
    squared = np.ones((1, 6, 1, len(AXES)))
    squared[..., 1] = 0.0
    cells = summary({"raw": squared, "nas": squared / 4}, np.arange(6), [1.0])["nas"]["1"]
    still = cells["left_m"]
    assert still["rmse"] == 0.0 and still["less_than_raw"] is still["less_than_raw_high"] is None
    assert cells["mean"]["less_than_raw"] == pytest.approx(0.5)
    json.dumps(cells, allow_nan=False)
    nowhere = summary({"raw": 0 * squared}, np.arange(6), [1.0])["raw"]["1"]["mean"]
    assert set(nowhere.values()) == {None}
