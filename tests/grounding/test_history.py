import json

import pytest
import torch
from grounding_models import TASK, failure_model, model

from astra_data.grounding.history import GroundedSimulator, HistoryGrounding


def test_simulators_are_corrected_by_the_model_and_replays_by_it_alone() -> None:
    whole = HistoryGrounding(model(), failure_model(), 0.3)
    assert whole.encoder is whole.model
    one = whole.simulator(TASK, 2)
    assert isinstance(one, GroundedSimulator)
    assert (one.model, one.failures, one.scatter_model) == (whole.model, whole.failures, None)
    assert (one.latent_size, one.latent.shape) == (8, (2, 8))
    assert whole.for_replay() == HistoryGrounding(whole.model, clearance_m=0.3)


@pytest.mark.parametrize("latent_size", [None, 0, 8])
def test_a_failure_model_is_saved_with_its_grounding(latent_size: int | None) -> None:
    failures = None if latent_size is None else failure_model(latent_size)
    tensors, metadata = HistoryGrounding(model(), failures).to_file()
    read = HistoryGrounding.from_file(dict(tensors), json.loads(json.dumps(metadata)), "cpu")
    assert ("failures" in metadata) == (read.failures is not None) == (failures is not None)
    if failures is not None and read.failures is not None:
        assert read.failures.shape == failures.shape
        saved = read.failures.state_dict()
        assert all(torch.equal(saved[name], one) for name, one in failures.state_dict().items())
