from astra_data.grounding.fit import HistoryFit
from astra_data.methods import METHODS, _faults, tables
from astra_data.policies.train import InSimulator


def test_settings_are_read_from_one_table_by_the_stage_that_takes_them() -> None:
    read = {name: (method.table.name, method.configures) for name, method in METHODS.items() if method.table}
    assert read == {
        "rma": ("rma", "train"),
        "target": ("target", "train"),
        "full_obs": ("target", "train"),
        "iql": ("iql", "train"),
        "behavior_cloning": ("iql", "train"),
        "direct_transfer_iql": ("iql", "train"),
    }
    assert list(tables()) == ["rma", "target", "iql"]  # recorded settings are compared as text as well: the order stays
    for method in METHODS.values():
        assert method.table is None or tables()[method.table.name] == method.table


def test_what_the_rows_of_the_paper_differ_in() -> None:
    """Those of ASTRA: see test_astra."""
    methods = [method for name, method in METHODS.items() if not name.startswith("astra")]
    assert [method.name for method in methods if method.grounds] == ["nas"]
    assert METHODS["nas"].fit == HistoryFit(latent=False, reward=False)
    assert not any(method.aligns for method in methods)
    assert [method.name for method in methods if not method.trains] == ["follower"]
    assert [method.name for method in methods if method.planar] == ["follower"]
    assert {method.name for method in methods if method.steps_target} == {"target", "full_obs"}
    learned = {method.name: method.learn for method in methods}
    in_simulator = {
        name: (learn.reward, learn.ranges) for name, learn in learned.items() if isinstance(learn, InSimulator)
    }
    assert in_simulator == {
        "direct_transfer": ("abstract", None),
        "domain_randomization": ("abstract", "randomized"),
        "nas": ("abstract", None),
        "rma": ("abstract", "wide"),
        "compass": ("abstract", "wide"),
    }


def test_the_methods_of_the_package_lack_nothing_that_is_asked_of_the_users() -> None:
    for method in METHODS.values():
        assert [*_faults(method)] == [] or not method.trains
        assert method.initial is None or method.initial in METHODS
