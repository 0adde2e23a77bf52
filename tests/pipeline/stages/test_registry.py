import inspect

from astra_data.pipeline.plan import ARTIFACTS
from astra_data.pipeline.stages.registry import STAGES


def test_a_stage_is_named_as_the_function_that_makes_it() -> None:
    for name, stage in STAGES.items():
        assert stage.name == name == stage.run.__name__
        assert stage.run.__module__ == f"astra_data.pipeline.stages.{name}"


def test_a_stage_reads_earlier_ones() -> None:
    assert {name: stage.reads for name, stage in STAGES.items()} == {
        "collect": (),
        "label": (),
        "augment": ("collect", "label"),
        "pair": ("collect", "label", "augment"),
        "subset": ("pair",),
        "ground": ("pair", "subset"),
        "train": ("pair", "subset", "ground"),
        "align": ("pair", "subset", "ground"),
        "select": ("pair", "subset", "ground", "train"),
        "evaluate": ("train", "ground", "align"),
        "report": ("evaluate",),
    }
    names = list(STAGES)
    for name, stage in STAGES.items():
        assert set(stage.reads) <= set(names[: names.index(name)])


def test_a_stage_asks_for_nothing_that_the_plan_does_not_know() -> None:
    known = {"task", "simulator", "method", "config", "settings", "seed", "percent", "of", "out", "device"}
    known |= {"data"}
    for stage in STAGES.values():
        if stage.each == "recipe":
            continue
        parameters = inspect.signature(stage.run).parameters.values()
        needed = {parameter.name for parameter in parameters if parameter.default is parameter.empty}
        assert needed <= known | set(ARTIFACTS) | {"progress"}, stage.name
        assert ("config" in {parameter.name for parameter in parameters}) == (stage.config is not None)
