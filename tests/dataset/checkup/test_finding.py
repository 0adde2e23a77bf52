from astra_data.dataset.checkup.finding import Finding, channels, deletion, labels, listed
from astra_data.dataset.columns import Column


def test_a_finding_is_one_line() -> None:
    finding = Finding("warning", "time stands still", "leave it out", (7,))
    assert str(finding) == "warning: time stands still (episode 7): leave it out"
    assert str(Finding("note", "constant: x", "check it")) == "note: constant: x: check it"
    assert finding.record() == {
        "severity": "warning",
        "what": "time stands still",
        "advice": "leave it out",
        "episodes": [7],
    }


def test_five_episodes_are_named_and_the_others_counted() -> None:
    assert listed(range(5)) == "episodes 0, 1, 2, 3, 4"
    assert listed(range(7)) == "episodes 0, 1, 2, 3, 4 and 2 more"
    assert deletion("walks", [3, 9]) == "astra-data delete walks --episode 3 --episode 9"
    assert deletion("walks", range(6)).endswith("--episode 3 --episode 4 ...")


def test_values_have_names() -> None:
    pose = Column("pose", size=2, names=("x", "y"))
    assert labels(pose) == ["x", "y"]
    assert labels(Column("charge")) == ["charge"]
    assert channels(pose, [1]) == "y of pose"
    assert channels(Column("pose", size=3), [0, 2]) == "0, 2 of pose"
    assert channels(Column("charge"), [0]) == "charge"
