from astra_data.core import naming


def test_a_row_is_a_method_or_its_plus() -> None:
    assert [naming.is_plus(row) for row in ("astra", "astra_plus", "plus_astra")] == [False, True, False]
    assert [naming.base_method(row) for row in ("astra", "astra_plus")] == ["astra", "astra"]
    assert naming.reference_of(["astra", "nas"]) == naming.reference_of(["astra", "nas_plus"]) == "nas"
    assert naming.reference_of(["astra", "compass"]) is None


def test_a_key_is_the_place_in_a_run() -> None:
    assert naming.artifact_key("train", "astra", 3, 5) == "train/astra/percent_005/seed_3"
    assert naming.artifact_key("pair", "", 0) == "pair/seed_0"
    assert [naming.stage_of_key(key) for key in ("train/astra/seed_0", "select")] == ["train", "select"]


def test_a_rows_key_goes_on_with_the_row_and_no_other_part_is_one() -> None:
    keys = ["train/astra/seed_0", "train/train/percent_050/seed_0", "ground/nas/seed_1", "report"]
    assert [naming.row_of_key(key) for key in keys] == ["astra", "train", "nas", ""]


def test_as_many_as_are_shown_are_all_named() -> None:
    """Others are counted."""
    assert (
        naming.first_few(["a", "b", "c"], 3) == "a, b, c" and naming.first_few((3, 1, 4, 1, 5), 2) == "3, 1 and 3 more"
    )


def test_a_long_text_is_cut_and_says_so() -> None:
    """One that fits stays as it is."""
    assert naming.shortened("grounding", 9) == "grounding" and naming.shortened("grounding", 8) == "groundin…"


def test_no_name_controls_a_terminal() -> None:
    """Colors, titles, links, lines of its own, or letters that run backwards."""
    name = "a\x1b[31mb\x1b]0;title\x07c\rd\ne\x9b\u202ef ä 腕"
    assert naming.printable(name) == "a\ufffd[31mb\ufffd]0;title\ufffdc\ufffdd\ufffde\ufffd\ufffdf ä 腕"


def test_no_name_in_a_message_begins_a_message() -> None:
    """All lines but the first are indented, once."""
    assert naming.in_lines("no field 'a\nfinished: b\x1b':\n  c") == "no field 'a\n  finished: b\ufffd':\n  c"


def test_no_name_is_more_than_words_in_markdown() -> None:
    """Neither tag nor heading, link or code."""
    text = "run\n# fast <script>alert(1)</script> [a](b) `c` x_1"
    shown = r"run # fast &lt;script&gt;alert(1)&lt;/script&gt; \[a\](b) \`c\` x_1"
    assert naming.in_markdown(text) == shown and naming.in_code("a`b\n```c") == "`a'b " + 3 * "'" + "c`"
