from astra_data.grounding.fit import GroundConfig, HistoryFit
from astra_data.grounding.model import LossWeights
from astra_data.methods import METHODS
from astra_data.policies.train import InSimulator

ROWS = {
    # λ1, λ2; whether it aligns; what pays; what its fit leaves out or adds
    "astra": (0.2, 0.3, True, "predicted", {}),
    "astra_without_latent": (0.0, 0.3, False, "predicted", {"latent": False}),
    "astra_without_reward": (0.2, 0.0, True, "abstract", {"reward": False}),
    "astra_task_reward": (0.2, 0.3, True, "abstract", {}),
    "astra_without_failures": (0.2, 0.3, True, "predicted", {"failures": False}),
    "astra_without_scatter": (0.2, 0.3, True, "predicted", {"scatter": False}),
    "astra_printed": (0.2, 0.3, True, "predicted", {"failures": False, "scatter": False, "printed": True}),
}


def test_the_rows_of_the_ablation_differ_by_one_part_each() -> None:
    rows = [name for name in METHODS if name.startswith("astra")]
    assert rows == [*ROWS]
    for name, (latent, reward, aligns, pays, differences) in ROWS.items():
        method = METHODS[name]
        assert isinstance(method.fit, HistoryFit) and isinstance(method.learn, InSimulator)
        weights = method.fit.weights(GroundConfig(latent_weight=0.2, reward_weight=0.3))
        assert weights == LossWeights(latent, reward, 1.0)
        assert (method.aligns, method.learn.reward, method.learn.ranges) == (aligns, pays, None)
        whole = {"latent": True, "reward": True, "failures": True, "scatter": True, "printed": False}
        assert vars(method.fit) == whole | differences | {"encoder": None}
        assert method.grounded_as == ("astra" if name == "astra_task_reward" else "")
