from astra_data.dataset.doctor.check import MOST, Report


def test_only_the_first_findings_of_a_kind_are_kept_and_all_are_counted() -> None:
    report = Report()
    for number in range(MOST + 3):
        report.fault("files", f"file {number} is broken")
    report.fault("counts", "one episode is missing")
    report.note("files", "a note")
    assert report.faults == [
        *(f"file {number} is broken" for number in range(MOST)),
        "files: and 3 more of this kind",
        "one episode is missing",
    ]
    assert report.fault_count == MOST + 4
    assert report.notes == ["a note"]


def test_as_many_findings_as_are_kept_are_all_of_them() -> None:
    report = Report()
    for number in range(MOST):
        report.note("files", f"note {number}")
    assert report.notes == [f"note {number}" for number in range(MOST)]
    assert (report.faults, report.fault_count) == ([], 0)
