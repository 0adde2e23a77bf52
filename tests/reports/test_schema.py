import json

import numpy as np
import pytest
from fake_runs import bare_results
from pydantic import ValidationError

from astra_data.reports.schema import BandMeans, GapMeans, Learning, Results
from astra_data.worlds.score import RETURN, SUCCESS

BARE = bare_results("toy", {"astra": [0, 1], "nas": [0, 1]}, {"seeds": [0, 1]})
(ROW, OTHER) = BARE.methods.values()


def stored(results: Results) -> str:
    return results.model_dump_json(by_alias=True)


def test_nan_is_null_in_json_and_comes_back() -> None:
    learning = [Learning(steps=[0, 10], score=[float("nan"), 0.5])] * 2
    row = ROW.model_copy(update={"distance": [float("nan"), 2.0], "learning": learning})
    text = stored(BARE.model_copy(update={"methods": {"astra": row}}))
    assert json.loads(text)["methods"]["astra"]["distance"] == [None, 2.0]
    back = Results.model_validate_json(text).methods["astra"]
    assert np.isnan([back.distance[0], back.learning[0].score[0]]).all()
    assert (back.distance[1], back.learning[0].score[1]) == (2.0, 0.5)


def test_names_of_files_differ_from_those_in_code_where_python_has_them_reserved() -> None:
    row = json.loads(stored(BARE))["methods"]["astra"]
    assert "return" in row and "returns" not in row
    # The score of a learning curve once was its success.
    old = row | {"learning": [{"steps": [1.0], "success": [0.25]}] * 2}
    assert type(ROW).model_validate(old).learning[0].score == [0.25]


def test_unknown_keys_are_refused_and_results_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="color"):
        Results.model_validate(json.loads(stored(BARE)) | {"color": "red"})
    with pytest.raises(ValidationError, match="frozen"):
        BARE.recipe = "other"


def test_what_published_results_lack_is_filled_in() -> None:
    values = json.loads(stored(BARE))
    for key in ("scores", "seeds", "leg_scale", "stand_in", "paper_success", "unfinished", "format"):
        del values[key]
    old = Results.model_validate(values)
    assert (old.headline, old.leg_scale, old.stand_in, old.unfinished) == (SUCCESS, 1.0, None, [])


def test_every_measure_has_a_name() -> None:
    row = ROW.model_copy(
        update={
            name: [float(number)] * 2
            for number, name in enumerate(
                ("success", "failed", "wall_contact", "steps", "returns", "distance", "simulated_success")
            )
        }
    )
    assert {name: values and values[0] for name, values in row.measures().items()} == {
        **{"success": 0, "failed": 1, "wall_contact": 2, "steps": 3, "return": 4, "distance": 5},
        **{"simulated_success": 6, "simulated_steps": None, "tries": None, "beyond_recorded": None},
    }


def test_rows_share_the_gap_of_their_grounding_and_the_first_score_is_the_headline() -> None:
    band = BandMeans(mean=[1.0], low=[0.5], high=[2.0])
    gap = GapMeans(seeds=[0], horizons=[1], grounded={"x_m": band}, raw={"x_m": band})
    rows = {
        "astra": ROW.model_copy(update={"grounding": "astra", "gap": gap}),
        "astra_plus": ROW.model_copy(update={"grounding": "astra", "gap": gap}),
        "nas": OTHER,
    }
    assert BARE.model_copy(update={"methods": rows}).gaps() == {"astra": gap}
    assert BARE.model_copy(update={"scores": (RETURN, SUCCESS)}).headline == RETURN
