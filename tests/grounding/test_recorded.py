import torch

from astra_data.grounding.paired_episodes import draw_steps

LENGTHS = torch.tensor([3, 10, 25])


def test_each_step_is_drawn_as_often_as_any_other() -> None:
    torch.manual_seed(0)
    episodes, steps, drawn = draw_steps(LENGTHS, 60_000, 8)
    assert episodes.shape == (60_000, 1) and steps.shape == drawn.shape == (60_000, 8)
    real = drawn & (steps < LENGTHS[episodes])
    counts = torch.zeros(3, 25)
    counts.index_put_((episodes.expand(-1, 8)[real], steps[real]), torch.ones(int(real.sum())), accumulate=True)
    assert [int((row > 0).sum()) for row in counts] == LENGTHS.tolist()
    usual = float(counts.sum() / LENGTHS.sum())
    assert counts[counts > 0].sub(usual).abs().max() < 0.05 * usual


def test_windows_are_steps_in_a_row_inside_their_episodes() -> None:
    torch.manual_seed(0)
    episodes, steps, drawn = draw_steps(LENGTHS, 2_000, 8)
    assert (steps.diff(dim=1) == 1).all()
    first, last = steps[:, 0], steps[:, -1]
    short = episodes[:, 0] == 0
    assert (first[short] == 0).all()  # padded at the end
    assert (first >= 0).all() and (last[~short] < LENGTHS[episodes[~short, 0]]).all()
    for row in range(3):
        reach = sorted(set(first[episodes[:, 0] == row].tolist()))
        assert reach == list(range(max(1, int(LENGTHS[row]) - 7)))
    # Of a window that was drawn across an end only the part inside counts: one stretch of at least a step.
    assert drawn.any(dim=1).all() and (drawn.int().diff(dim=1).abs().sum(1) <= 1).all()
