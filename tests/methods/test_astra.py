import pytest

from astra_data.grounding.fit import GroundConfig, HistoryFit
from astra_data.learning.networks.grounding import LossWeights
from astra_data.methods import METHODS
from astra_data.training.train import InSimulator


@pytest.mark.parametrize(
    ("row", "latent", "reward", "aligns", "pays"),
    [
        ("astra", 0.2, 0.3, True, "predicted"),
        ("astra_without_latent", 0.0, 0.3, False, "predicted"),
        ("astra_without_reward", 0.2, 0.0, True, "abstract"),
        ("astra_task_reward", 0.2, 0.3, True, "abstract"),
    ],
)
def test_the_rows_of_table_ii(row: str, latent: float, reward: float, aligns: bool, pays: str) -> None:
    method = METHODS[row]
    assert isinstance(method.fit, HistoryFit) and isinstance(method.learn, InSimulator)
    weights = method.fit.weights(GroundConfig(latent_weight=0.2, reward_weight=0.3))
    assert weights == LossWeights(latent, reward, 1.0)
    assert method.aligns == aligns
    assert (method.learn.reward, method.learn.ranges) == (pays, None)


def test_the_task_reward_row_shares_the_grounding_and_the_others_have_their_own() -> None:
    rows = [name for name in METHODS if name.startswith("astra")]
    assert {name: METHODS[name].grounded_as for name in rows if METHODS[name].grounded_as} == {
        "astra_task_reward": "astra"
    }
    assert METHODS["astra_task_reward"].fit == METHODS["astra"].fit
