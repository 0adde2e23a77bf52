from astra_data.grounding.fit import HistoryFit
from astra_data.methods import METHODS
from astra_data.policies.train import InSimulator

ROWS = {
    "astra": (True, "predicted", {}),  # whether it aligns; what pays; what its fit leaves out or adds
    "astra_without_latent": (False, "predicted", {"latent": False}),
    "astra_without_reward": (True, "abstract", {"reward": False}),
    "astra_task_reward": (True, "abstract", {}),
    "astra_without_failures": (True, "predicted", {"failures": False}),
    "astra_without_scatter": (True, "predicted", {"scatter": False}),
    "astra_printed": (True, "predicted", {"failures": False, "scatter": False, "printed": True}),
}


def test_the_rows_of_the_ablation_differ_by_one_part_each() -> None:
    assert [name for name in METHODS if name.startswith("astra")] == [*ROWS]
    for name, (aligns, pays, differences) in ROWS.items():
        method = METHODS[name]
        assert isinstance(method.fit, HistoryFit) and isinstance(method.learn, InSimulator)
        assert (method.aligns, method.learn.reward, method.learn.ranges) == (aligns, pays, None)
        whole = {"latent": True, "reward": True, "failures": True, "scatter": True, "printed": False}
        assert vars(method.fit) == whole | differences | {"encoder": None}
        assert method.grounded_as == ("astra" if name == "astra_task_reward" else "")
