from html_pages import read_page

from astra_data.reports.blocks import Code, Picture, Section, TableBlock, Text, code, html, inline, markdown

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (400).to_bytes(4) + (200).to_bytes(4)

SECTIONS = [
    Section("", [Text("Before `a < b` & **all**", warns=True)]),
    Section(
        "The table",
        [
            Text("", ["one", "two"]),
            TableBlock("Numbers", ["method", "kind", "success"], [["A|B", "x", "0.5"]], words=2),
            TableBlock("Nothing", ["method"], []),
            Code("astra-data run <recipe>"),
            Picture("drawn", "A figure", "It shows."),
            Picture("missing", "Not drawn", "It is left out."),
        ],
    ),
    Section("Nothing at all", [TableBlock("", ["method"], []), Picture("missing", "Not drawn", "")]),
    Section("Folded", [Text("Details")], folded=True),
]


def test_both_pages_have_the_same_content() -> None:
    text = markdown("r", SECTIONS, {"drawn": "r_drawn.png"})
    page = read_page(html("r", SECTIONS, {"drawn": PNG}))
    for shown in (text, page.text):
        for words in ("Before", "The table", "Numbers", "A figure", "It shows.", "Folded", "Details", "one"):
            assert words in shown
        for words in ("Nothing", "Not drawn"):
            assert words not in shown


def test_markdown_is_what_github_shows() -> None:
    text = markdown("r", SECTIONS, {"drawn": "r_drawn.png"})
    assert text.startswith("# r\n\nBefore `a < b` & **all**\n\n## The table\n\n- one\n- two\n\nNumbers:\n\n")
    assert "| method | kind | success |\n| --- | --- | ---: |\n| A\\|B | x | 0.5 |" in text
    assert "```\nastra-data run <recipe>\n```" in text
    assert "### A figure\n\n![A figure](r_drawn.png)\n\nIt shows." in text


def test_html_escapes_what_anybody_wrote_and_loads_nothing() -> None:
    hostile = "<script>alert(1)</script>"
    text = Text(f"Task {code(hostile)} {hostile}")
    page = html(
        hostile, [Section(hostile, [text, TableBlock(hostile, [hostile], [[hostile]]), Code(hostile)])]
    )
    assert "<script>" not in page
    assert "default-src 'none'" in page
    assert code("a`b\n# c") == "`ab # c`"
    assert inline("**Of** `a<b` & *c*") == "<strong>Of</strong> <code>a&lt;b</code> &amp; *c*"


def test_each_value_carries_the_title_of_its_column_which_phones_show_beside_it() -> None:
    page = read_page(html("r", SECTIONS, {"drawn": PNG}))
    cells = [attributes.get("data-label") for attributes in page.attributes("td")]
    assert cells == ["kind", "success"]
    (image,) = page.attributes("img")
    assert (image["width"], image["height"]) == ("200", "100")
    css = html("r", [])
    assert "attr(data-label)" in css and "filter: invert" in css
