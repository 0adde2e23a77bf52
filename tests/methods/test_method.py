from astra_data.core.config import Config
from astra_data.methods.method import Method, Table
from astra_data.policies.train import InSimulator, InTarget

PLAIN = Method(name="mine", title="Mine")


def test_by_default_a_method_trains_in_the_raw_simulator() -> None:
    assert (PLAIN.grounds, PLAIN.trains, PLAIN.in_simulator, PLAIN.steps_target) == (False, True, True, False)
    assert PLAIN.learn == InSimulator(reward="abstract", ranges=None)
    assert not (PLAIN.aligns or PLAIN.planar or PLAIN.initial or PLAIN.table or PLAIN.role or PLAIN.color)


def test_where_a_policy_comes_from() -> None:
    by_hand = Method(name="mine", title="Mine", learn=None)
    assert not by_hand.trains and not by_hand.in_simulator and not by_hand.steps_target
    assert not by_hand.trains_without_target
    there = Method(name="mine", title="Mine", learn=InTarget("full"), learns_from="target")
    assert there.trains and there.steps_target and not there.in_simulator
    assert not there.trains_without_target
    recorded = Method(name="mine", title="Mine", learns_from="episodes")
    assert recorded.trains and not recorded.in_simulator and not recorded.steps_target
    assert recorded.trains_without_target and PLAIN.trains_without_target


def test_a_table_has_the_defaults_of_its_model() -> None:
    table = Table("mine", Config)
    assert (table.name, table.model, table.default) == ("mine", Config, None)
