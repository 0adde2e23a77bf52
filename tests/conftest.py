import importlib
import os
from typing import TYPE_CHECKING, Any

import fake_stages
import pytest
from pydantic import create_model

if TYPE_CHECKING:
    from astra_data.experiments.recipe import Recipe

# Before torch and numpy are loaded: tests run side by side, a core each.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture
def fake_recipe(monkeypatch: pytest.MonkeyPatch) -> "type[Recipe]":
    """Replace the stages, methods and tasks by fake ones, and return the model of their recipes."""
    # Imported here, so that tests of other parts need not wait for every stage.
    plan = importlib.import_module("astra_data.experiments.plan")
    request = importlib.import_module("astra_data.experiments.recipe")
    tables = [name for name in (*request.STAGES, "plus") if name in request.Recipe.model_fields]
    sections: dict[str, tuple[Any, Any]] = {name: (fake_stages.FakeConfig, ...) for name in tables}
    sections["collect"] = (fake_stages.FakeCollectConfig, ...)
    sections["augment"] = (fake_stages.FakeConfig | None, None)
    model: type[Recipe] = create_model("FakeRecipe", __base__=request.Recipe, **sections)  # type: ignore[call-overload]
    for stage in request.STAGES:
        monkeypatch.setattr(plan, stage, getattr(fake_stages, stage))
    experiment = importlib.import_module("astra_data.experiments.experiment")
    for module in (plan, request, experiment):
        monkeypatch.setattr(module, "METHODS", fake_stages.METHODS)
    monkeypatch.setitem(fake_stages.TASKS, "maze", request.TASKS["antmaze-umaze"])
    for module in (request, experiment):
        monkeypatch.setattr(module, "TASKS", fake_stages.TASKS)
    monkeypatch.setattr("astra_data.experiments.experiment.Recipe", model)
    # Without torch and the real stages, the spawned processes start at once.
    monkeypatch.setattr(plan, "Reported", fake_stages.Reported)
    monkeypatch.setattr("torch.set_num_threads", int)
    return model
