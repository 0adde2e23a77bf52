from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.reports.choice import Candidate, Judged
from astra_data.reports.choice_page import select_page
from astra_data.reports.trials import TRIALS, TrialRound, TrialsFile, Tried, read_trials

CANDIDATES = [
    Candidate(row=row, seed=1, success={0: lower, 2: lower}) for row, lower in (("astra", 0.5), ("nas", 0.25))
]
JUDGED = Judged(judge="nas", episodes=5, candidates=CANDIDATES)
FIRST = TrialRound(
    trials=2,
    candidates=[("astra", 1), ("nas", 1)],
    tried=[Tried(row="astra", seed=1, success=[0, 1]), Tried(row="nas", seed=1, success=[1, 1])],
)
BEGUN = TrialsFile(trials=9, field=2, pseudo_trials=4, rounds=[FIRST])


def test_trials_are_read_as_they_were_written(tmp_path: Path) -> None:
    assert read_trials(tmp_path / TRIALS) is None
    (tmp_path / TRIALS).write_text(BEGUN.model_dump_json())
    assert read_trials(tmp_path / TRIALS) == BEGUN and BEGUN.spent == 4
    (tmp_path / TRIALS).write_text("{}")
    with pytest.raises(BadInputError, match="trials"):
        read_trials(tmp_path / TRIALS)


def test_the_page_says_who_was_tried_how_often_with_what_success() -> None:
    assert "Trials in the target" not in select_page("cart", JUDGED)
    page = select_page("cart", JUDGED, BEGUN)
    assert "## Trials in the target\n\nNot finished: run the same command again. 4 of 9 episodes" in page
    assert "| 1 | ASTRA | 1 | 1 | 2 | 0.50 |" in page and "| 1 | NAS | 1 | 2 | 2 | 0.50 |" in page
    second = TrialRound(trials=2, candidates=[("nas", 1)], tried=[Tried(row="nas", seed=1, success=[1, 1])])
    done = BEGUN.model_copy(update={"rounds": [FIRST, second], "chosen": ("nas", 1), "mean": 0.625})
    page = select_page("cart", JUDGED, done)
    assert (
        "**NAS, seed 1**: success 0.62, estimated from the prediction and the trials. 6 of 9 episodes" in page
    )
    assert "| 2 | NAS | 1 | 2 | 2 | 0.62 |" in page  # (4 · 0.25 + 4) / (4 + 4)


def test_the_prior_of_trials_is_the_lower_quartile() -> None:
    one = Candidate(row="astra", seed=1, success={0: 0.0, 2: 1.0})
    judged = Judged(judge="nas", episodes=5, candidates=[one])
    tried = TrialRound(
        trials=2, candidates=[("astra", 1)], tried=[Tried(row="astra", seed=1, success=[0, 1])]
    )
    page = select_page("cart", judged, BEGUN.model_copy(update={"rounds": [tried]}))
    assert "| 1 | ASTRA | 1 | 1 | 2 | 0.33 |" in page  # (4 · 0.25 + 1) / (4 + 2)
