import json

import pytest
import torch
from grounding_models import failure_model, model

from astra_data.grounding.history import HistoryGrounding


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
