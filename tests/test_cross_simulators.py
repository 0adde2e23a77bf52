import json
from pathlib import Path

import cross_simulators
import pytest
from small_run import COLLECT, GROUND, TASK, TRAIN, short_task

from astra_data.core.progress import silent
from astra_data.stages.collect import collect
from astra_data.stages.ground import ground
from astra_data.stages.pair import PairConfig, pair
from astra_data.stages.train import train

ROWS = ["nas", "astra"]


def test_every_policy_acts_in_every_simulator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "recipe.json").write_text(json.dumps({"task": TASK}))
    with short_task():
        walks = collect(TASK, COLLECT, seed=0, out=tmp_path / "collect/seed_0", progress=silent)
        pairs = pair(TASK, PairConfig(), dataset=walks, out=tmp_path / "pair/seed_0")
        for row in ROWS:
            grounding = tmp_path / f"ground/{row}/seed_0"
            ground(TASK, row, GROUND, dataset=pairs, out=grounding)
            (tmp_path / f"align/{row}/seed_0").mkdir(parents=True)
            (tmp_path / f"align/{row}/seed_0/target_encoder.safetensors").touch()
            train(TASK, row, TRAIN, dataset=pairs, grounding=grounding, out=tmp_path / f"train/{row}/seed_0")
        found = cross_simulators.outcomes(tmp_path, ROWS, 0, None, 3)
        cross_simulators.main(tmp_path, ROWS, [0, 0], episodes=3)
    names = [(simulator, acting) for simulator in ROWS for acting in ("follower", *ROWS)]
    assert [*found] == names
    # The follower starts and goes alike everywhere, and each simulator lets it go elsewhere.
    paths = [found[row, "follower"].position for row in ROWS]
    assert (paths[0][:, 0] == paths[1][:, 0]).all() and not (paths[0][:, -1] == paths[1][:, -1]).all()
    assert not (found["nas", "nas"].position[:, -1] == found["nas", "astra"].position[:, -1]).any()
    head, _, *lines = capsys.readouterr().out.splitlines()
    assert head == "| simulator of | who acts | success | failed | steps |"
    for line, name in zip(lines, names, strict=True):
        simulator, acting, success, failed, steps = line.strip("| ").split(" | ")
        assert (simulator, acting) == name
        assert success == failed == "0.00, 0.00"
        assert steps == ", ".join([f"{sum(found[name].steps) / 3:.0f}"] * 2)
