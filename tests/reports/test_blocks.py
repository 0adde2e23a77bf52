import re
from base64 import b64encode
from pathlib import Path

from html_pages import read_page

from astra_data.core.naming import in_code
from astra_data.reports import blocks

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (400).to_bytes(4) + (200).to_bytes(4)

SECTIONS = [
    blocks.Section("", [blocks.Text("Before `a < b` & **all**", warns=True)]),
    blocks.Section(
        "The table",
        [
            blocks.Text("", ["one", "two"]),
            blocks.TableBlock("Numbers", ["method", "kind", "success"], [["A|B", "x", "0.5"]], words=2),
            blocks.TableBlock("Nothing", ["method"], []),
            blocks.Code("astra-data run <recipe>"),
            blocks.Picture("drawn", "A figure", "It shows."),
            blocks.Picture("missing", "Not drawn", "It is left out."),
        ],
    ),
    blocks.Section(
        "Nothing at all", [blocks.TableBlock("", ["method"], []), blocks.Picture("missing", "Not drawn", "")]
    ),
]


def test_both_pages_have_the_same_content() -> None:
    text = blocks.markdown("r", SECTIONS, {"drawn": "r_drawn.png"})
    page = read_page(blocks.html("r", SECTIONS, {"drawn": PNG}))
    for shown in (text, page.text):
        for words in ("Before", "The table", "Numbers", "A figure", "It shows.", "one"):
            assert words in shown
        for words in ("Nothing", "Not drawn"):
            assert words not in shown


def test_markdown_is_what_github_shows() -> None:
    text = blocks.markdown("r", SECTIONS, {"drawn": "r_drawn.png"})
    assert text.startswith("# r\n\n> Before `a < b` & **all**\n\n## The table\n\n- one\n- two\n\nNumbers:\n\n")
    assert "| method | kind | success |\n| --- | --- | ---: |\n| A\\|B | x | 0.5 |" in text
    assert "```\nastra-data run <recipe>\n```" in text
    assert "### A figure\n\n![A figure](r_drawn.png)\n\nIt shows." in text


def test_html_escapes_what_anybody_wrote_and_loads_nothing() -> None:
    hostile = "<script>alert(1)</script> [a](http://a) ![b](http://b)"
    text = blocks.Text(f"Task {in_code(hostile)} {hostile}")
    page = blocks.html(
        hostile,
        [blocks.Section(hostile, [text, blocks.TableBlock(hostile, [hostile], [[hostile]]), blocks.Code(hostile)])],
    )
    assert "<script>" not in page and "default-src 'none'" in page and 'href="http' not in page
    cells = blocks.markdown("r", [blocks.Section("s", [blocks.TableBlock("", [hostile], [[f"{hostile}\n# a"]])])])
    assert "<" not in cells and "\n# a" not in cells


def test_sections_are_linked_and_figures_drawn_on_white_are_dark_where_the_page_is() -> None:
    text = blocks.html("r", SECTIONS, {"drawn": PNG})
    page = read_page(text)
    assert page.attributes("a") == [{"href": "#the-table"}] and page.attributes("h2") == [{"id": "the-table"}]
    source = f"data:image/png;base64,{b64encode(PNG).decode()}"
    assert page.attributes("img") == [{"src": source, "alt": "A figure", "width": "200"}]
    dark = re.findall(r"prefers-color-scheme: dark\) \{(.*?)\n\}", text, flags=re.DOTALL)
    (rule,) = (line for block in dark for line in block.splitlines() if "img" in line)
    assert "img { filter: invert(" in rule
    site = (Path(__file__).parents[2] / "docs/site.css").read_text()
    assert re.search(r'data-md-color-scheme="slate"\] .*img \{ filter: invert\(', site)


def test_columns_of_words_are_aligned_left_and_of_numbers_right() -> None:
    assert blocks.table(["a", "b", "c"], [["x", "1", "2"], ["y", "3", "4"]]) == (
        "| a | b | c |\n| --- | ---: | ---: |\n| x | 1 | 2 |\n| y | 3 | 4 |"
    )
    assert blocks.table(["a", "b", "c"], [], words=2).endswith("| --- | --- | ---: |")


def test_words_and_times_are_written_as_in_a_sentence() -> None:
    assert [blocks.listed(list("abc")[:count]) for count in (0, 1, 2, 3)] == ["", "a", "a and b", "a, b and c"]
    times = {None: "-", 0: "0 s", 99: "99 s", 100: "2 min", 5399: "90 min", 5400: "1.5 h", 36000: "10.0 h"}
    assert [blocks.duration(seconds) for seconds in times] == list(times.values())
