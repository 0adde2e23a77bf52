import json
from pathlib import Path

import probe_latents
import pytest
from small_run import ALIGN, COLLECT, GROUND, TASK, TRAIN, short_task

from astra_data.core.progress import silent
from astra_data.stages.align import align
from astra_data.stages.collect import collect
from astra_data.stages.ground import ground
from astra_data.stages.pair import PairConfig, pair
from astra_data.stages.train import train


def test_a_small_run_is_probed_and_its_policy_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = {"task": TASK, "ground": GROUND.model_dump()}
    (tmp_path / "recipe.json").write_text(json.dumps(settings))
    with short_task():
        walks = collect(TASK, COLLECT, seed=0, out=tmp_path / "collect/seed_0", progress=silent)
        pairs = pair(TASK, PairConfig(), dataset=walks, out=tmp_path / "pair/seed_0")
        grounding = tmp_path / "ground/astra/seed_0"
        ground(TASK, "astra", GROUND, dataset=pairs, out=grounding)
        align(ALIGN, dataset=pairs, grounding=grounding, out=tmp_path / "align/astra/seed_0")
        out = tmp_path / "train/astra/seed_0"
        train(TASK, "astra", TRAIN, dataset=pairs, grounding=grounding, out=out)
        for where in ("target", "simulator"):
            probe_latents.main(tmp_path, ["astra"], steps=3, policies=probe_latents.Where(where), episodes=3)
            lines = capsys.readouterr().out.splitlines()
            assert lines[0] == "| R² of | φ(s) | φ(s) and 3 actions | z of astra |"
            names = [line.split("|")[1].strip() for line in lines[2:] if line]
            assert names[:2] == ["z", "yaw, cosine"] and names[26:29] == ["way, x", "way, y", "mean"]
            assert lines[-3] == f"| success in the {where} with latents | own | another's | zeros |"
            assert lines[-1].startswith("| astra | 0.")
