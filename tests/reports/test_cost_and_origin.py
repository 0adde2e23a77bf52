from fake_runs import bare_results

from astra_data.reports.cost_and_origin import (
    dataset_lines,
    machine,
    machines,
    provenance,
    row_costs,
    stage_costs,
)
from astra_data.reports.schema import Cost, DatasetOrigin, DatasetUse, Machine, Origin

MACHINE = Machine(cpu="Fast", cores=8, memory_gib=15.5)
BARE = bare_results("toy", {"astra": [0, 1], "nas": [0, 1]}, {})


def origin(**changes: object) -> Origin:
    usual = Origin(commit="abc", machine=MACHINE, packages={"torch": "2.0", "gone": None}, stages=["train"])
    return usual.model_copy(update=changes)


def test_an_origin_that_all_share_is_named_without_stages() -> None:
    assert provenance([origin(), origin(stages=["pair"])], {}) == {
        "code": "commit `abc`",
        "machine": "Fast, 8 cores, 15.5 GiB of memory",
        "versions": "torch 2.0",
    }


def test_code_of_ones_own_is_named_by_its_digests() -> None:
    told = provenance([origin()], {"task": "0a", "mine": "1b"})
    assert told == provenance([origin()], {}) | {"own_code": "task `0a`, mine `1b`"}


def test_origins_that_differ_are_named_with_their_stages_once() -> None:
    origins = [
        origin(commit="abc-dirty"),
        origin(commit=None, stages=["pair"], machine=None, packages={}),
        origin(commit="abc-dirty", stages=["train", "align"]),
    ]
    text = provenance(origins, {})
    assert text["code"] == "commit `abc` with uncommitted changes (train, align); not recorded (pair)"
    assert text["versions"] == "torch 2.0 (train, align); not recorded (pair)"
    assert machine(origins[1]) == "not recorded"
    with_gpu = MACHINE.model_copy(update={"gpu": "H200"})
    assert machine(origin(machine=with_gpu)).endswith("15.5 GiB of memory, H200")


def test_a_machine_is_named_once_with_the_gpu_that_some_stages_used() -> None:
    with_gpu = origin(machine=MACHINE.model_copy(update={"gpu": "H200"}))
    other = origin(machine=MACHINE.model_copy(update={"cpu": "Faster"}))
    both = "Fast, 8 cores, 15.5 GiB of memory, H200 and Faster, 8 cores, 15.5 GiB of memory"
    assert machines([with_gpu, origin(), other, origin()]) == machines([origin(), with_gpu, other]) == both


def test_each_stage_has_its_times_and_the_range_of_its_speeds() -> None:
    speeds = {
        "steps_per_second": {"astra": [1000.0, 3000.0], "nas": [500.0]},
        "simulator_steps_per_second": {"astra": [7.0], "nas": [7.0]},
        "updates_per_second": {},
    }
    results = BARE.model_copy(
        update={
            "wall_seconds": {"train": 30.0, "align": 200.0, "total": 230.0},
            "cpu_seconds": {"train": 60.0, "total": 60.0},
            "throughput": {"train": speeds, "ground": {"windows_per_second": {}}},
        }
    )
    rates = "500 (NAS) to 2 k (ASTRA) training steps/s; 7 simulator steps/s"
    assert stage_costs(results) == [
        ["train", "30 s", "60 s", rates],
        ["align", "3 min", "-", ""],
        ["whole recipe", "4 min", "60 s", ""],
    ]
    assert stage_costs(BARE) == [["whole recipe", "0 s", "-", ""]]


def test_a_row_costs_the_sum_of_its_stages_where_all_recorded_it() -> None:
    ground, train = Cost(wall_seconds=10, cpu_seconds=40), Cost(wall_seconds=20, cpu_seconds=None)
    astra, nas = BARE.methods.values()
    rows = {
        "astra": astra.model_copy(update={"title": "A", "cost": {"ground": ground, "train": train}}),
        "nas": nas.model_copy(update={"title": "N", "cost": {"ground": ground, "evaluate": ground}}),
    }
    assert row_costs(BARE.model_copy(update={"methods": rows})) == [
        ["A", "10 s", "20 s", "-", "-", "30 s", "-"],
        ["N", "10 s", "-", "-", "10 s", "20 s", "80 s"],
    ]
    assert row_costs(BARE)[0][-2:] == ["0 s", "-"]


def test_datasets_are_named_with_their_contents_and_who_used_them() -> None:
    def dataset(stage: str, seed: int, content_hash: str) -> DatasetOrigin:
        return DatasetOrigin(stage=stage, seed=seed, name="set", version="v1", content_hash=content_hash)

    results = BARE.model_copy(
        update={
            "datasets": [dataset("collect", 0, "a"), dataset("collect", 1, "b"), dataset("pair", 0, "c")],
            "evaluated_with": [
                DatasetUse(versions=["v1", "v1"], hashes=["a", "b"], methods=["astra"]),
                DatasetUse(versions=[None, None], hashes=[None, None], methods=["nas"]),
            ],
        }
    )
    assert dataset_lines(results) == [
        "Dataset of `collect`: set v1, content `a` (seed 0), `b` (seed 1).",
        "Dataset of `pair`: set v1, content `c` (seed 0).",
        "Dataset named by the evaluations of astra: v1 (`a`, `b`).",
        "Dataset named by the evaluations of nas: no dataset.",
    ]
