import torch
from toy_worlds import GoToZero

from astra_data.policies.sac import Replay

ROWS = 3


def replay(size: int, steps: int) -> Replay:
    """Return a replay of what tells the step it is of and, in tenths, the row."""
    kept = Replay(size, GoToZero(ROWS), 2, torch.device("cpu"))
    for step in range(steps):
        value = step + torch.arange(ROWS) / 10
        nothing = torch.zeros(ROWS, dtype=torch.bool)
        kept.add(
            observation=value[:, None],
            previous_action=-value[:, None],
            hidden=torch.stack([2 * value, 3 * value], dim=-1),
            action=10 * value[:, None],
            reward=100 * value,
            terminated=torch.tensor([step % 5 == 4, False, False]),
            expired=torch.tensor([False, step % 5 == 4, False]),
            first=nothing | (step % 5 == 0),
        )
    return kept


def test_windows_are_steps_in_a_row_of_the_most_recent() -> None:
    kept = replay(ROWS * 12, 40)
    assert len(kept) == 12
    drawn, _ = kept.windows(2000, 4, 0)
    observation = drawn["observation"].squeeze(-1)
    torch.testing.assert_close(observation.diff(dim=1), torch.ones(2000, 4))
    assert sorted(set(observation[:, 0].floor().int().tolist())) == list(range(28, 36))
    assert set((observation[:, 0] % 1 * 10).round().int().tolist()) == {0, 1, 2}
    torch.testing.assert_close(drawn["action"].squeeze(-1), 10 * observation)
    torch.testing.assert_close(drawn["previous_action"].squeeze(-1), -observation)
    torch.testing.assert_close(drawn["hidden"][..., 1], 3 * observation)
    torch.testing.assert_close(drawn["reward"], 100 * observation)


def test_what_is_learned_from_has_a_known_outcome_and_a_filled_memory() -> None:
    kept = replay(ROWS * 100, 60)
    drawn, learned = kept.windows(500, 7, 2)
    for window, (observation, use) in enumerate(zip(drawn["observation"].squeeze(-1), learned, strict=True)):
        begin, row = int(observation[0] + 0.05), round(float(observation[0] % 1) * 10)
        for index in range(7):
            step = begin + index
            known = row != 1 or step % 5 != 4
            filled = index >= 2 or any(seen % 5 == 0 for seen in range(begin, step + 1))
            assert bool(use[index]) == (known and filled), (window, index)


def test_nothing_is_learned_across_a_cut() -> None:
    """Where an episode had ended there, it stays as it was."""
    kept = replay(ROWS * 12, 40)
    before = kept.state_dict()
    expired = torch.as_tensor(before["expired"]).clone()
    kept.cut()
    last = 39 % 12
    expired[last] = ~torch.as_tensor(before["terminated"])[last]
    assert expired[last].any() and not expired[last].all()
    assert torch.equal(torch.as_tensor(kept.state_dict()["expired"]), expired)
    replay(ROWS * 12, 0).cut()
