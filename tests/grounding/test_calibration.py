import pytest
import torch

from astra_data.grounding.failures import calibration, folds


def test_log_odds_are_scaled_and_shifted_to_what_happens() -> None:
    """Two members say twice and four times too much of events whose log-odds they know."""
    torch.manual_seed(0)
    true = 1.5 * torch.randn(40_000) - 2.0
    happens = (torch.rand(len(true)) < true.sigmoid()).float()
    for factor in (2.0, 0.5):
        scale, shift = calibration((factor * (true + 1.0)).expand(2, -1), happens, 1)
        assert float(scale) == pytest.approx(1 / factor, rel=0.05)
        assert float(shift) == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize(("failing", "count"), [(1, 0), (2, 2), (4, 4), (13, 5)])
def test_folds_share_failing_and_other_episodes_alike(failing: int, count: int) -> None:
    torch.manual_seed(0)
    fails = torch.arange(40) >= 40 - failing
    each = torch.arange(40)
    found = folds(fails, each)
    assert len(found) == count
    if found:
        assert torch.equal(torch.stack(found).sum(0), torch.ones(40, dtype=torch.long))
        for rows in (fails, ~fails):
            sizes = [int((fold & rows).sum()) for fold in found]
            assert max(sizes) - min(sizes) <= 1
        assert found[0].nonzero().squeeze(1).tolist() != [*range(0, 40, count)]  # at random
    assert not torch.equal(torch.stack(folds(fails, each) or [fails]), torch.stack(found or [~fails]))


def test_copies_are_in_the_fold_of_their_recording() -> None:
    torch.manual_seed(0)
    recordings = torch.tensor([9, 9, 9, 4, 4, 4, 7, 7, 7, 2, 2, 2])
    fails = recordings >= 7
    found = folds(fails, recordings)
    assert len(found) == 2  # recordings that fail, though six episodes do
    for fold in found:
        for recording in recordings.unique():
            assert len(fold[recordings == recording].unique()) == 1
        assert int((fold & fails).sum()) == int((fold & ~fails).sum()) == 3
    assert folds(recordings == 9, recordings) == []
    torch.manual_seed(1)
    alone, shuffled = folds(fails, torch.arange(12)), torch.tensor([7, 3, 11, 0, 5, 9, 1, 10, 2, 8, 6, 4])
    torch.manual_seed(1)
    assert torch.equal(torch.stack(alone), torch.stack(folds(fails, shuffled)))
