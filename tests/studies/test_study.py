from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from toy_walks import FPS, piece

from astra_data.core.durable import held
from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.studies.errors import Starts
from astra_data.studies.gap_recipe import GapRecipe
from astra_data.studies.predictors import Gains
from astra_data.studies.recordings import Piece, Recording
from astra_data.studies.rollouts import FitConfig
from astra_data.studies.sequences import Sequences, StepsConfig
from astra_data.studies.study import cases, run_study, shortened

STEPS = StepsConfig(rows=10, history=4)


def recipe(**changes: object) -> GapRecipe:
    usual = {"mapping": "m.toml", "models": ("gains",), "seeds": (3, 4), "horizons_s": (0.5,), "steps": STEPS}
    return GapRecipe.model_validate(usual | changes)


def recording(name: str, count: int = 4, rows: int = 150, fps: int = FPS) -> Recording:
    pieces = tuple(piece(rows, 10 * len(name) + ord(name[0]) + number) for number in range(count))
    return Recording(name, f"hash of {name}", fps, pieces)


A, B = recording("a"), recording("b", count=8)


def rows_of(pieces: tuple[Piece, ...]) -> int:
    return sum(map(len, pieces))


def test_one_case_holds_pieces_out_and_others_hold_out_a_recording() -> None:
    held_out, on_a, on_b = cases(recipe(minutes=(0.1,)), [A, B], [])
    assert held_out.title == "Tested on held-out pieces of a and b"
    assert (len(held_out.test), len(held_out.training)) == (1 + 2, 3 + 6)
    ids = {id(one) for one in (*held_out.test, *held_out.training)}
    assert ids == {id(one) for one in (*A.pieces, *B.pieces)}
    # A quarter of each recording, not of both together.
    assert sum(any(one is other for other in A.pieces) for one in held_out.test) == 1
    assert (on_a.name, on_a.training, on_a.test) == ("tested_on_a", B.pieces, A.pieces)
    assert on_b.title == "Learned from a, tested on b"
    assert (held_out.minutes, on_a.minutes) == ((0.1,), ())
    again = next(iter(cases(recipe(), [A, B], [])))
    assert all(one is other for one, other in zip(again.test, held_out.test, strict=True))


def test_the_held_out_share_is_that_of_the_recipe() -> None:
    (only,) = cases(recipe(held_out_share=0.5), [B], [])
    assert (len(only.test), len(only.training)) == (4, 4)
    (least,) = cases(recipe(held_out_share=0.01), [B], [])
    assert len(least.test) == 1
    (most,) = cases(recipe(held_out_share=0.99), [B], [])
    assert len(most.training) == 1
    with pytest.raises(BadInputError, match=r"at least two pieces without a split.*--train"):
        list(cases(recipe(), [recording("short", count=1)], []))


def test_given_recordings_are_learned_from_alone() -> None:
    (only,) = cases(recipe(), [A], [B])
    assert (only.training, only.test) == (B.pieces, A.pieces)
    assert only.title == "Learned from b, tested on a"


def test_smaller_sizes_lie_inside_larger_ones() -> None:
    small, large = (shortened(B.pieces, rows, seed=1) for rows in (200, 700))
    assert (rows_of(small), rows_of(large)) == (200, 700)
    np.testing.assert_array_equal(small[0].state, large[0].state)
    cut = small[1]
    assert len(cut) == 50 and len(cut.state) == 51 and len(cut.broken) == 50
    np.testing.assert_array_equal(cut.action, large[1].action[:50])
    assert rows_of(shortened(B.pieces, 10**6, seed=1)) == rows_of(B.pieces)
    other = shortened(B.pieces, 200, seed=2)
    assert not np.array_equal(other[0].action, small[0].action)


def test_the_raw_simulator_is_always_a_model_and_unknown_ones_are_refused() -> None:
    assert recipe(models=("astra", "ridge", "astra")).models == ("raw", "astra", "ridge")
    assert recipe(models=("ridge", "raw")).models == ("raw", "ridge")
    with pytest.raises(ValidationError, match="unknown model 'rigde': did you mean 'ridge'"):
        recipe(models=("rigde",))


def test_errors_are_those_of_the_fitted_models_and_fits_are_kept(tmp_path: Path) -> None:
    quick = FitConfig(updates=1, batch=4, steps=2, latent_size=4, head_sizes=(4,), hidden_sizes=(4,))
    settings = recipe(minutes=(0.1,), models=("gains", "nas"), fit=quick)
    found = run_study(settings, [A], [B], tmp_path / "study", silent)
    (case,) = found["cases"]
    small, whole = case["sizes"]
    assert (small["minutes"], whole["minutes"]) == pytest.approx((0.1, 1200 / FPS / 60))
    starts = Starts.of(Sequences.of_pieces(A.pieces, FPS, STEPS), 4, (1, 3))
    raw = starts.squared_errors(Gains()).double().numpy()
    cell = whole["models"]["raw"]["0.5"]["forward_m"]
    assert cell["rmse"] == pytest.approx(np.sqrt(np.nanmean(raw[:, 1, 0])), abs=1e-5)
    assert case["starts"] == [int(np.isfinite(raw[:, k, 0]).sum()) for k in range(2)]
    assert (case["pieces"], case["test_minutes"]) == (4, pytest.approx(600 / FPS / 60))
    # Only what a seed changes is repeated: with all data, gains do not depend on it, and networks do.
    fits = sorted(str(path.relative_to(tmp_path / "study")) for path in tmp_path.rglob("*.safetensors"))
    assert fits == [
        "new_recordings/gains/0.1_min/seed_3.safetensors",
        "new_recordings/gains/0.1_min/seed_4.safetensors",
        "new_recordings/gains/all/seed_3.safetensors",
        "new_recordings/nas/0.1_min/seed_3.safetensors",
        "new_recordings/nas/0.1_min/seed_4.safetensors",
        "new_recordings/nas/all/seed_3.safetensors",
        "new_recordings/nas/all/seed_4.safetensors",
        "new_recordings/raw/0.1_min/seed_3.safetensors",
        "new_recordings/raw/all/seed_3.safetensors",
    ]
    again = run_study(settings, [A], [B], tmp_path / "study", silent)
    assert again["cases"] == found["cases"]


def test_a_folder_holds_one_study_at_a_time(tmp_path: Path) -> None:
    run_study(recipe(models=("raw",)), [A], [B], tmp_path, silent)
    with pytest.raises(BadInputError, match="other settings or other recordings: remove it"):
        run_study(recipe(models=("raw",)), [A], [A], tmp_path, silent)
    # What failed before its first fit left nothing that could be mixed up.
    with pytest.raises(BadInputError, match="expected pieces of more than"):
        long = recipe(models=("raw",), steps=StepsConfig(rows=10, history=1000))
        run_study(long, [A], [B], tmp_path / "failed", silent)
    run_study(recipe(models=("raw",)), [A], [B], tmp_path / "failed", silent)
    # Models, seeds, sizes and notes may be others.
    run_study(recipe(models=("raw",), seeds=(9,), notes=("new",)), [A], [B], tmp_path, silent)
    with held(tmp_path) as ours, pytest.raises(BadInputError, match="is in use by another run"):
        assert ours
        run_study(recipe(models=("raw",)), [A], [B], tmp_path, silent)


def test_recordings_of_several_rates_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="one rate, got 30, 60 per second"):
        run_study(recipe(), [A], [recording("slow", fps=30)], tmp_path, silent)


def test_a_horizon_below_a_control_step_is_one_step(tmp_path: Path) -> None:
    short = recipe(models=("raw",), horizons_s=(0.05, 0.5))
    (case,) = run_study(short, [A], [B], tmp_path, silent)["cases"]
    assert case["horizons_s"] == pytest.approx([1 / 6, 0.5])


def test_recordings_without_walking_are_refused(tmp_path: Path) -> None:
    pieces = tuple(replace(piece, broken=np.ones(len(piece), bool)) for piece in A.pieces)
    still = replace(A, pieces=pieces)
    with pytest.raises(BadInputError, match="expected 1 control steps that count, after 4 of any kind"):
        run_study(recipe(models=("raw",)), [still], [B], tmp_path / "a", silent)
    with pytest.raises(BadInputError, match=r"expected stretches of 4 \+ 1 steps to fit to"):
        run_study(recipe(models=("ridge",)), [B], [still], tmp_path / "b", silent)


def test_pieces_that_are_too_short_to_fit_to_are_told_with_their_steps(tmp_path: Path) -> None:
    short = recording("c", rows=60)
    told = r"of 4 \+ 6 steps to fit to, .* found 0 in pieces of 6 steps or fewer: .*piece_s"
    with pytest.raises(BadInputError, match=told):
        run_study(recipe(models=("gains",)), [A], [short], tmp_path, silent)


def test_a_size_of_less_than_a_row_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"expected pieces of more than 0\.8 s without a split"):
        run_study(recipe(minutes=(1e-5,)), [A], [B], tmp_path, silent)


def test_ridge_regression_fits_to_pieces_that_are_late_as_a_whole(tmp_path: Path) -> None:
    short = recipe(models=("ridge",), fit={"steps": 1})
    (case,) = run_study(short, [A], [recording("short", rows=55)], tmp_path, silent)["cases"]
    assert np.isfinite(case["sizes"][0]["models"]["ridge"]["0.5"]["forward_m"]["rmse"])
