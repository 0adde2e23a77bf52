import pytest

from astra_data.core.errors import BadInputError
from astra_data.grounding.descent import refuse_divergence


def test_figures_that_are_not_finite_are_named() -> None:
    refuse_divergence("by step 8", {"std": 0.5, "unknown": None})
    with pytest.raises(BadInputError, match="training diverged by step 8, with a std and a loss that is not"):
        refuse_divergence("by step 8", {"std": float("nan"), "kl": 1e30, "loss": float("-inf")})
