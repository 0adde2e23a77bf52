import pytest

from astra_data.core.errors import BadInputError
from astra_data.grounding.fit import GroundConfig, HistoryFit
from astra_data.learning.networks.grounding import LossWeights
from astra_data.methods import METHODS, method_named
from astra_data.reports.figures import method_colour, method_title
from astra_data.reports.figures.style import SPARE_COLOURS
from astra_data.training.train import InSimulator


def weights(name: str) -> LossWeights | None:
    fit = METHODS[name].fit
    config = GroundConfig(latent_weight=0.2, reward_weight=0.3)
    return fit.weights(config) if isinstance(fit, HistoryFit) else None


def reward(name: str) -> str:
    learn = METHODS[name].learn
    assert isinstance(learn, InSimulator)
    return learn.reward


def test_methods_are_known_by_their_names() -> None:
    assert all(name == method.name for name, method in METHODS.items())
    assert method_named("astra_plus") is method_named("astra") is METHODS["astra"]
    with pytest.raises(BadInputError, match="unknown method 'astro'; known: direct_transfer, "):
        method_named("astro")


def test_figures_call_methods_by_their_titles_in_colours_of_their_own() -> None:
    assert {name: method_title(name) for name in METHODS} == {
        name: method.title for name, method in METHODS.items()
    }
    colours = [method_colour(name) for name in METHODS]
    assert len(set(colours)) == len(colours)
    assert not set(colours).intersection(SPARE_COLOURS)


def test_what_the_rows_of_the_paper_differ_in() -> None:
    assert weights("direct_transfer") is None
    assert weights("nas") == LossWeights(0.0, 0.0, 1.0)
    assert weights("astra") == LossWeights(0.2, 0.3, 1.0)
    assert weights("astra_without_latent") == LossWeights(0.0, 0.3, 1.0)
    assert weights("astra_without_reward") == LossWeights(0.2, 0.0, 1.0)
    assert {name for name, method in METHODS.items() if method.aligns} == {
        "astra",
        "astra_without_reward",
        "astra_task_reward",
    }
    assert [name for name, method in METHODS.items() if not method.trains] == ["follower"]
    assert {name for name, method in METHODS.items() if method.steps_target} == {"target", "full_obs"}
    assert [reward(name) for name in ("direct_transfer", "nas", "astra")] == ["abstract"] * 2 + ["predicted"]
    assert [reward(name) for name in ("astra_without_reward", "astra_task_reward")] == ["abstract"] * 2


def test_what_a_method_borrows_is_there() -> None:
    for method in METHODS.values():
        assert METHODS[method.grounded_as or method.name].fit == method.fit
        assert method.initial is None or METHODS[method.initial].trains
        if method.in_simulator:
            assert not method.learns_from("predicted") or method.grounds
