import pytest

from astra_data.reports.artifacts import Artifact, CurveFile, DatasetFile, Evaluation, Metrics
from astra_data.reports.costs import (
    DATASET_STAGES,
    THROUGHPUT,
    Files,
    seconds,
    seed_cost,
    throughput,
    with_first,
)
from astra_data.reports.schema import Cost


def metrics(**values: float) -> Metrics:
    return Metrics.model_validate(values)


def curve(**values: float) -> CurveFile:
    return CurveFile.model_validate({"points": [{"steps": 0, "success": None}], **values})


def files(**stages: dict[str, list[Artifact]]) -> Files:
    return {stage: stages.get(stage, {}) for stage in THROUGHPUT}


def test_time_is_summed_over_what_recorded_it() -> None:
    found = files(
        ground={"astra": [metrics(wall_seconds=3, cpu_seconds=5), metrics(wall_seconds=4)]},
        train={"astra": [curve(wall_seconds=10)], "astra_plus": [curve(wall_seconds=20), curve()]},
        align={"astra": [metrics()]},
    )
    assert seconds(found, "wall_seconds") == {"ground": 7.0, "train": 30.0, "total": 37.0}
    assert seconds(found, "cpu_seconds") == {"ground": 5.0, "total": 5.0}
    assert seconds(files(), "wall_seconds") == {"total": 0}


def test_a_seed_costs_what_its_stages_recorded() -> None:
    made = {
        "ground": metrics(wall_seconds=3, cpu_seconds=5),
        "train": curve(),
        "align": metrics(wall_seconds=1),
    }
    assert seed_cost(made) == {
        "ground": Cost(wall_seconds=3, cpu_seconds=5),
        "align": Cost(wall_seconds=1, cpu_seconds=None),
    }


@pytest.mark.parametrize(
    ("stage", "model"),
    [
        *(("ground", Metrics), ("align", Metrics), ("train", CurveFile), ("evaluate", Evaluation)),
        *((stage, DatasetFile) for stage in DATASET_STAGES),
    ],
)
def test_every_speed_is_one_that_the_stages_file_may_have(stage: str, model: type[Artifact]) -> None:
    assert {*THROUGHPUT[stage]} <= model.model_fields.keys()


@pytest.mark.parametrize("figure", THROUGHPUT["ground"])
def test_rows_without_a_speed_for_every_seed_are_left_out(figure: str) -> None:
    found = throughput(
        files(
            ground={"astra": [metrics(**{figure: 5}), metrics(**{figure: 7})], "nas": [metrics()], "rma": []}
        )
    )
    assert {name: rows for name, rows in found["ground"].items() if rows} == {figure: {"astra": [5, 7]}}
    assert found["evaluate"] == {"target_steps_per_second": {}}
    partly = throughput(files(ground={"astra": [metrics(**{figure: 5}), metrics()]}))
    assert partly["ground"][figure] == {}


def test_a_training_that_goes_on_from_another_costs_both() -> None:
    own = {"train": Cost(wall_seconds=10, cpu_seconds=20), "align": Cost(wall_seconds=1, cpu_seconds=2)}
    first = curve(wall_seconds=3, cpu_seconds=5)
    both = own | {"train": Cost(wall_seconds=13, cpu_seconds=25)}
    assert with_first(own, first) == both
    assert with_first(own, curve(wall_seconds=3))["train"] == Cost(wall_seconds=13, cpu_seconds=None)
    assert with_first(own, None) == with_first(own, curve()) == own
