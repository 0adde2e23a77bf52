import json
from base64 import b64decode
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_runs import SEEDS, FakeRecipe, write_runs
from html_pages import Page, read_page
from PIL import Image

from astra_data.reports.assembly import assemble
from astra_data.reports.files import published_figures, read_published
from astra_data.reports.html_page import render_html
from astra_data.reports.schema import Results

PUBLISHED = Path(__file__).parents[2] / "recipes/results"
PREDICTIONS = {PUBLISHED / "nao_real.json"}
"""Of `astra-data gap`, whose pages are other ones."""
EVERY = sorted({*PUBLISHED.glob("*.json")} - PREDICTIONS)
LOSSES = "Mean ± standard deviation over seeds"


def html_of(path: Path) -> str:
    return render_html(read_published(path), published_figures(PUBLISHED, path.stem))


def published(name: str) -> tuple[Page, Any]:
    path = PUBLISHED / f"{name}.json"
    return read_page(html_of(path)), json.loads(path.read_text())


def toy(parent: Path, seeds: tuple[int, ...] = SEEDS) -> Results:
    root = write_runs(parent)
    return assemble(FakeRecipe("toy", seeds=seeds), root=root, command="astra-data run", replicates=100)


def shows(cell: str, values: list[float], digits: int = 2) -> bool:
    """Tell whether a cell is the mean ± sample standard deviation, computed by hand, up to rounding."""
    mean = sum(values) / len(values)
    std = (sum((value - mean) ** 2 for value in values) / (len(values) - 1)) ** 0.5
    parts = cell.split(" ± ")
    assert all(len(part.partition(".")[2]) == digits for part in parts)
    return bool(np.allclose([float(part) for part in parts], [mean, std], rtol=0, atol=0.5001 * 10**-digits))


@pytest.mark.parametrize("path", EVERY, ids=lambda path: path.stem)
def test_a_page_loads_nothing_and_shows_every_figure(path: Path) -> None:
    page = read_page(html_of(path))
    assert [page.attributes(tag) for tag in ("script", "iframe", "object", "embed")] == [[]] * 4
    addresses = [
        attributes[key] or ""
        for tag, attributes in page.tags
        for key in ("src", "href", "srcset", "data")
        if key in attributes and tag != "a"
    ]
    assert all(address.startswith("data:") for address in addresses)
    policy = page.attributes("meta")[3]
    assert policy["http-equiv"] == "Content-Security-Policy"
    assert policy["content"] == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    figures = published_figures(PUBLISHED, path.stem)
    shown = [b64decode((image["src"] or "").partition("base64,")[2]) for image in page.attributes("img")]
    assert sorted(shown) == sorted(figures.values())
    for image, png in zip(page.attributes("img"), shown, strict=True):
        assert image["alt"]
        width, height = Image.open(BytesIO(png)).size
        assert (image["width"], image["height"]) == (f"{width // 2}", f"{height // 2}")


@pytest.mark.parametrize("path", EVERY, ids=lambda path: path.stem)
def test_its_structure_can_be_read_by_machines(path: Path) -> None:
    page = read_page(html_of(path))
    assert set(page.scopes) == {"col", "row"}
    assert len(page.attributes("h1")) == len(page.attributes("main")) == 1
    assert len(page.attributes("figure")) == len(page.attributes("figcaption")) == len(page.attributes("img"))
    places = [attributes["id"] for tag, attributes in page.tags if tag == "section"]
    assert [f"#{place}" for place in places] == [link["href"] for link in page.attributes("a")]
    order = ["verdict", "lost", "pictures", "gap", "size", "training", "details"]
    assert places == [name for name in order if name in places]
    last = [index for index, (tag, _) in enumerate(page.tags) if tag == "details"]
    figures = [index for index, (tag, _) in enumerate(page.tags) if tag == "figure"]
    assert min(last) > max(figures)
    boxed = [role for tag, role in page.tags if tag == "div" and role.get("class") == "scroll"]
    assert len(boxed) == len(page.attributes("table"))


@pytest.mark.parametrize("name", ["antmaze_long_fresh", "cart_study", "nao_kick"])
def test_what_was_lost_is_what_the_numbers_give(name: str) -> None:
    page, values = published(name)
    head, *lines = page.table(LOSSES)
    assert [cell.replace("\N{NO-BREAK SPACE}", " ") for cell in head] == [
        *("row", "episodes in the target", "success in its simulator"),
        *("success in the target", "IQM [95 %]", "lost", "failed", "out of time", "seeds"),
    ]
    for row, cells in zip(values["methods"].values(), lines, strict=True):
        role = f" {row['role']}" if row["role"] else ""
        summary = row["summary"]["success"]
        out = [1 - s - f for s, f in zip(row["success"], row["failed"], strict=True)]
        own = row["simulated_success"]
        assert cells[0] == row["title"] + role
        assert cells[8] == f"{len(row['seeds'])}"
        assert shows(cells[2], own) if own else cells[2] == "-"
        assert shows(cells[3], row["success"])
        # The mean of the middle half, rounded up: of five seeds of three, of four of two, of three of all.
        cut = len(row["success"]) // 4
        middle = np.sort(row["success"])[cut : len(row["success"]) - cut]
        ends = f"[{summary['low']:.2f}, {summary['high']:.2f}]"
        assert cells[4] == f"{np.mean(middle):.2f} {ends}"
        lost = np.mean(own) - np.mean(row["success"]) if own else None
        assert cells[5] == "-" if lost is None else abs(float(cells[5]) - lost) < 0.0051
        assert shows(cells[6], row["failed"]) and shows(cells[7], np.abs(out).tolist())


def test_bars_tell_how_episodes_ended() -> None:
    text = html_of(PUBLISHED / "cart_study.json")
    row = json.loads((PUBLISHED / "cart_study.json").read_text())["methods"]["astra"]
    success, failed, own = (float(np.mean(row[of])) for of in ("success", "failed", "simulated_success"))
    late = 1 - success - failed
    label = f"success {success:.2f}, failed {failed:.2f}, out of time {late:.2f}; "
    label += f"success in its simulator {own:.2f}"
    assert f'aria-label="{label}"' in text
    bar = text.partition(label)[2].partition("</svg>")[0]
    widths = [part.partition('"')[0] for part in bar.split(' width="')[1:]]
    places = [part.partition('"')[0] for part in bar.split(' x="')[1:]]
    assert widths == [f"{1000 * share:.1f}" for share in (success, failed, late)]
    assert places == ["0.0", f"{1000 * success:.1f}", f"{1000 * (success + failed):.1f}"]
    # At the very end the mark of the simulator would be cut off.
    assert own == 1.0 and bar.count('d="M997.0 0V100"') == 2


def test_of_lasting_tasks_it_shows_survived_steps_and_return() -> None:
    page, values = published("humanoid_walker2d")
    head, *lines = page.table(LOSSES)
    assert head[2:4] == ["survived steps in its simulator", "survived steps in the target"]
    assert head[5] == "return in the target" and head[-3:-1] == ["failed", "lasted"]
    row = values["methods"]["astra_plus"]
    (cells,) = [cells for cells in lines if cells[0] == "ASTRA+"]
    assert shows(cells[3], row["steps"], 0) and shows(cells[5], row["return"], 1)
    assert cells[7] == f"{np.mean(row['simulated_steps']) - np.mean(row['steps']):.0f}"
    assert shows(cells[-2], [1 - failed for failed in row["failed"]])
    assert "out of time" not in page.text


def test_what_the_grounding_leaves_is_compared_at_ten_steps() -> None:
    page, values = published("antmaze_long_fresh")
    gap = values["methods"]["nas"]["gap"]
    place = gap["horizons"].index(10)
    left, raw = (gap[of]["position_m"]["mean"][place] for of in ("grounded", "raw"))
    head, line, _ = page.table("Error after 10 steps")
    assert head == ["quantity", "NAS", "ASTRA"]
    assert line[:2] == ["position_m", f"{left:.3g} of {raw:.3g} ({100 * left / raw:.0f} %)"]


def test_sizes_stand_in_a_table_and_the_rest_is_of_the_largest() -> None:
    page, values = published("cart_sizes")
    head, nas, astra = page.table("Success in the target, mean")
    assert head == ["method", "10 %", "25 %", "50 %", "100 %"]
    rows = [size["results"]["methods"] for size in values["sizes"]]
    for row, nas_cell, astra_cell in zip(rows, nas[1:], astra[1:], strict=True):
        assert shows(nas_cell, row["nas"]["success"]) and shows(astra_cell, row["astra"]["success"])
    assert shows(page.table(LOSSES)[2][3], rows[-1]["astra"]["success"])
    assert "trained on 100\N{NO-BREAK SPACE}% of 60 episodes of data for each of 5 seeds" in page.words


def test_results_of_no_target_say_so_above_the_verdict(tmp_path: Path) -> None:
    page = read_page(render_html(toy(tmp_path).model_copy(update={"tested_in": "simulators"}), {}))
    warned, judged = (page.text.index(of) for of in ("Nothing was tested on a robot", "Deploy ASTRA+"))
    assert warned < judged
    assert "success in a simulator" in page.table(LOSSES)[0]


def test_one_seed_has_neither_spread_nor_comparisons_and_few_policies_no_correlation(tmp_path: Path) -> None:
    results = toy(tmp_path, seeds=(1,))
    images = published_figures(PUBLISHED, "antmaze_long_fresh")
    page = read_page(render_html(results, images))
    assert "±" not in "".join(cell for line in page.table(LOSSES)[1:] for cell in line)
    assert {cells[4] for cells in page.table(LOSSES)[1:]} == {"one seed"}
    assert (
        "intervals over seeds are withheld: they need at least two seeds, and every row has one" in page.text
    )
    assert "The probability of improvement is withheld: it compares seeds, and there is one." in page.text
    assert (
        "in the raw and grounded simulator and in the target is withheld: 4 policies are too few" in page.text
    )
    assert not any(title.startswith(("Probability", "Correlation")) for title in page.tables)
    assert len(page.attributes("img")) == len(images) - 1


def test_enough_seeds_are_compared_and_correlated(tmp_path: Path) -> None:
    page = read_page(render_html(toy(tmp_path), {}))
    assert "withheld" not in page.text
    # Of nine pairs of seeds ASTRA wins seven and ties two: 0.5, 0.25, 0.75 against 0.25, 0, 0.25.
    assert [line[:3] for line in page.table("Probability")[1:]] == [["ASTRA", "Direct transfer", "0.89"]]
    (line,) = page.table("Probability")[1:]
    assert line[4:] == ["0.33", "[-0.03, 0.69]"]  # 0.25, 0.25 and 0.5, with t = 4.303
    assert [line[:2] for line in page.table("Correlation")[1:]] == [["raw", "12"], ["grounded", "9"]]


def test_names_are_text_whatever_they_hold(tmp_path: Path) -> None:
    evil = '<script>alert("1")</script><img src=http://x/y.png>'
    results = toy(tmp_path)
    rows = {name: row.model_copy(update={"title": f"{evil}{name}"}) for name, row in results.methods.items()}
    named = results.model_copy(
        update={
            "methods": rows,
            "task": evil,
            "recipe": evil,
            "command": evil,
            "unfinished": [evil],
            "stand_in": evil,
            "settings": {"collect": {"episodes": 3, "note": evil}},
        }
    )
    text = render_html(named, published_figures(PUBLISHED, "antmaze_long_fresh"))
    page = read_page(text)
    assert page.attributes("script") == [] and "<script" not in text
    assert all((image["src"] or "").startswith("data:") for image in page.attributes("img"))
    assert [cells[0] for cells in page.table(LOSSES)[1:]][1] == f"{evil}astra"
    assert any(evil in (image["alt"] or "") for image in page.attributes("img"))


def test_details_hold_what_made_it_and_every_seed() -> None:
    page, values = published("antmaze_long_fresh")
    assert values["command"] in page.text
    assert all(dataset["content_hash"] in page.text for dataset in values["datasets"])
    assert values["origins"][0]["commit"] in page.text
    head, *lines = page.table("Every seed")
    expected = [
        (row["title"], f"{seed}", f"{success:.4g}")
        for row in values["methods"].values()
        for seed, success in zip(row["seeds"], row["success"], strict=True)
    ]
    assert head[:3] == ["row", "seed", "success"]
    assert [tuple(line[:3]) for line in lines] == expected
    assert len(page.table("Best first")) == 1 + len(values["choice"]["candidates"])
    assert (
        json.loads(page.words[page.words.index('{\n  "task"') : page.words.rindex("}") + 1])
        == values["settings"]
    )


def test_failures_that_are_foreseen_have_a_table_and_a_figure(tmp_path: Path) -> None:
    (png, *_) = published_figures(PUBLISHED, "cart_study").values()
    line = ["ASTRA: failure model", "12", "0.91", "0.80", "-", "0.30", "0.20 of 0.25"]
    results = toy(tmp_path)
    page = read_page(render_html(results, {"reliability": png}, [line]))
    assert page.table("On held-out episodes")[1] == line
    assert len(page.attributes("img")) == 1 and "Reliability of the failure model" in page.text
    assert "Reliability" not in read_page(render_html(results, {})).text


def test_correlations_and_comparisons_stand_below_their_names(tmp_path: Path) -> None:
    page = read_page(render_html(toy(tmp_path), {}))
    # Returns are 0, 1 and 2 in the target and 0, 1 and 4 in the raw simulator: in order, not on a line.
    head, raw, _ = page.table("Correlation")
    assert head == ["simulator", "policies", "Pearson [95 %]", "Spearman [95 %]"]
    assert raw[2].startswith("0.96 [") and raw[3].startswith("1.00 [")
    page, values = published("antmaze_long_fresh")
    found = [of for others in values["probability_of_improvement"].values() for of in others.values()]
    assert [line[2:] for line in page.table("Probability")[1:]] == [
        [
            f"{of['probability']:.2f}",
            f"[{of['low']:.2f}, {of['high']:.2f}]",
            f"{of['difference']['mean']:.2f}",
            f"[{of['difference']['low']:.2f}, {of['difference']['high']:.2f}]",
        ]
        for of in found
    ]


def test_sizes_have_a_table_of_interquartile_means_too() -> None:
    page, values = published("cart_sizes")
    head, nas, _ = page.table("Interquartile mean with its 95 % interval")
    assert head == ["method", "10 %", "25 %", "50 %", "100 %"]
    for size, cell in zip(values["sizes"], nas[1:], strict=True):
        row = size["results"]["methods"]["nas"]
        summary = row["summary"]["success"]
        middle = np.mean(np.sort(row["success"])[1:-1])  # of five seeds
        assert cell == f"{middle:.2f} [{summary['low']:.2f}, {summary['high']:.2f}]"


@pytest.mark.parametrize(
    ("special", "told"),
    [
        ({"leg_scale": 1.25}, "The target\N{RIGHT SINGLE QUOTATION MARK}s legs are 1.25 times as long."),
        ({"unfinished": ["RMA", "NAS"]}, "Not finished yet: RMA, NAS."),
        (
            {"stand_in": "mujoco"},
            "A simulated stand-in (mujoco) replaces the physical robot",
        ),
    ],
)
def test_the_head_says_what_is_special(tmp_path: Path, special: dict[str, object], told: str) -> None:
    results = toy(tmp_path)
    assert told in read_page(render_html(results.model_copy(update=special), {})).text
    assert told not in read_page(render_html(results, {})).text


def test_what_is_foreseen_stands_below_its_window(tmp_path: Path) -> None:
    page = read_page(render_html(toy(tmp_path), {}, [["x"] * 7]))
    head = [cell.replace("\N{EN DASH}", " to ") for cell in page.table("On held-out episodes")[0]]
    assert head == [
        *(
            "simulator",
            "failures",
            "AUC 1 to 20 steps",
            "11 to 30",
            "21 to 40",
            "Brier skill",
            "observed of predicted",
        )
    ]
