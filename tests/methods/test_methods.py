import pytest

from astra_data.errors import BadInputError
from astra_data.methods import METHODS, method_named


def test_methods_are_known_by_their_names() -> None:
    assert all(name == method.name for name, method in METHODS.items())
    assert method_named("astra_plus") is method_named("astra") is METHODS["astra"]
    with pytest.raises(BadInputError, match="unknown method 'astro'; known: direct_transfer, nas, astra"):
        method_named("astro")


def test_what_the_rows_of_the_paper_differ_in() -> None:
    weights = {name: method.loss_weights for name, method in METHODS.items()}
    assert weights["direct_transfer"] is None
    assert weights["nas"] is not None
    assert (weights["nas"].latent, weights["nas"].reward, weights["nas"].state) == (0.0, 0.0, 1.0)
    assert weights["astra"] is not None
    assert min(vars(weights["astra"]).values()) > 0
    assert [name for name, method in METHODS.items() if method.aligns] == ["astra"]
    assert [name for name, method in METHODS.items() if not method.trains] == ["follower"]
    assert METHODS["astra"].reward == "predicted"
