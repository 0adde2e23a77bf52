import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from rail_run import rail_run

from astra_data.core.artifact import read_manifest
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.pipeline.stages.select import SelectConfig, benches, judge_of, select
from astra_data.policies.episodes import judged_success
from astra_data.reports.artifacts import read_json
from astra_data.reports.choice import Judged
from astra_data.reports.runs import Reported

pytestmark = pytest.mark.usefixtures("quick_fits")

ROWS, SEEDS = ("direct_transfer", "nas"), (0, 1, 2)


@pytest.fixture
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rail_run(tmp_path_factory, seeds=[0, 1, 2], methods=["direct_transfer", "nas"])


def reported(root: Path, **changes: Any) -> Reported:
    settings = json.loads((root / "recipe.json").read_text()) | changes.pop("settings", {})
    usual = {"name": "rail", "task": settings["task"], "methods": ROWS, "seeds": SEEDS}
    return Reported(**usual | {"settings": settings} | changes)


def judged(root: Path, recipe: Reported | None = None, progress: Progress = silent, **settings: Any) -> Judged:
    config = SelectConfig(**{"episodes": 5} | settings)
    select(recipe or reported(root), config, root=root, progress=progress)
    return read_json(Judged, root / "select/select.json")


def test_each_policy_is_judged_by_the_groundings_of_other_seeds(root: Path) -> None:
    found = judged(root)
    assert [(one.row, one.seed) for one in found.candidates] == [(r, s) for r in ROWS for s in SEEDS]
    assert all(one.success.keys() == {*SEEDS} - {one.seed} for one in found.candidates)
    assert found.judge == "nas" and found.episodes == 5 and not found.shares_episodes
    assert found.wall_seconds and found.packages
    page = (root / "select/select.md").read_text()
    assert page.count("| 2 | - |") == 6 and "fitted to the episodes of other seeds" in page
    assert "Regret" not in page and "no judge is independent" not in page


def test_who_judges_whom_with_what_drawn_where(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def success(task: object, judge: object, policy: Any, episodes: int, seed: int) -> float:
        asked.append((policy, episodes, seed))
        return len(asked) / 100

    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_success", success)
    found = judged(root, episodes=7)
    assert {episodes for _, episodes, _ in asked} == {7}
    # In the order of rows, seeds and judges; rows of one seed meet the same starts and goals.
    assert found.candidates[0].success == {1: 0.01, 2: 0.02} and found.candidates[5].success == {0: 0.11, 1: 0.12}
    drawn = [seed for *_, seed in asked]
    assert drawn[:6] == drawn[6:] and len(set(drawn)) == 6
    latents = [policy.source_encoder is not None for policy, *_ in asked]
    assert latents == [False] * 6 + [True] * 6  # NAS brings the encoder of its own grounding


def test_the_artifact_names_all_that_it_was_made_from(root: Path) -> None:
    judged(root)
    manifest = read_manifest(root / "select")
    assert manifest is not None and set(manifest.files) == {"config.json", "select.json"}
    policies = {f"train/{row}/seed_{seed}" for row in ROWS for seed in SEEDS}
    assert set(manifest.made_from) == policies | {f"ground/nas/seed_{seed}" for seed in SEEDS}
    assert manifest.made_from["train/nas/seed_1"] == file_digest(root / "train/nas/seed_1/policy.safetensors")
    grounding = root / "ground/nas/seed_2/grounding.safetensors"
    assert manifest.made_from["ground/nas/seed_2"] == file_digest(grounding)
    keys = benches(reported(root), "nas")[0].keys
    assert set(keys) == set(manifest.made_from) and len(keys) == len(set(keys))
    with pytest.raises(BadInputError, match="is already finished"):
        judged(root)


def test_an_interrupted_choice_goes_on_with_the_next_judge(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, asked = judged(root), list[object]()
    shutil.rmtree(root / "select")

    def success(*given: Any) -> float:
        asked.append(given)
        if len(asked) == 6:
            raise KeyboardInterrupt
        return judged_success(*given)

    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_success", success)
    with pytest.raises(KeyboardInterrupt):
        judged(root)
    assert not (root / "select").exists() and judged(root).candidates == whole.candidates
    assert len(asked) == 6 + 12 - 5
    assert not (root / "select/begun.json").exists()


def test_another_policy_is_judged_anew_after_an_interruption(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def success(task: object, judge: object, policy: object, episodes: int, seed: int) -> float:
        asked.append(seed)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return 0.5

    monkeypatch.setattr("astra_data.pipeline.stages.select.judged_success", success)
    with pytest.raises(KeyboardInterrupt):
        judged(root)
    first, second = (root / f"train/direct_transfer/seed_{seed}" for seed in (0, 1))
    shutil.copytree(second, first, dirs_exist_ok=True)
    judged(root)
    assert asked[3:5] == asked[:2]


def test_who_learned_in_the_target_or_nowhere_is_not_judged(root: Path) -> None:
    half, whole = benches(reported(root, methods=("follower", "target", "full_obs", "nas"), percents=(50, 100)), "nas")
    assert {one.row for one in half.entries} == {"nas"} and (half.percent, whole.percent) == (50, 100)
    assert {"train/nas/percent_050/seed_0", "ground/nas/percent_050/seed_2"} < {*half.keys}


def test_judges_of_the_same_episodes_are_named(root: Path) -> None:
    found = judged(root, reported(root, methods=("nas",), settings={"data": "logs@data-1.0.0"}))
    assert found.shares_episodes
    page = (root / "select/select.md").read_text()
    assert "fitted to the same episodes" in page and "no judge is independent of the policies it judges" in page


def test_what_is_not_there_is_asked_for(root: Path) -> None:
    with pytest.raises(BadInputError, match=r"as judge, got direct_transfer"):
        judged(root, judge="direct_transfer")
    with pytest.raises(BadInputError, match=r"expected groundings of astra for two seeds or more, found 0"):
        judged(root, judge="astra")
    with pytest.raises(BadInputError, match=r"found no policy of astra: run the recipe until train first"):
        judged(root, reported(root, methods=("astra",)))
    with pytest.raises(BadInputError, match="such as nas or astra, as judge, got none"):
        judge_of(None, ("direct_transfer",))
    assert judge_of("astra_plus", ()) == "astra" and judge_of(None, ("astra", "nas_plus")) == "nas"
    assert judge_of(None, ("direct_transfer", "astra_plus")) == "astra"  # without NAS, it grounds as well
    (root / "alone").mkdir()
    alone = Path(shutil.copytree(root / "train", root / "alone/train")).parent
    shutil.copytree(root / "ground/nas/seed_1", alone / "ground/nas/seed_1")
    with pytest.raises(BadInputError, match="groundings of nas for two seeds or more, found 1"):
        select(reported(root), root=alone)
    shutil.rmtree(root / "ground/nas/seed_1")
    assert len(judged(root, reported(root)).candidates) == 5  # of NAS, seed 1 has no encoder


def test_groundings_that_were_swapped_are_noticed(root: Path) -> None:
    one, other, aside = (root / "ground/nas" / name for name in ("seed_0", "seed_1", "aside"))
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    with pytest.raises(BadInputError, match="was made from another grounding than the one used with it"):
        judged(root)
