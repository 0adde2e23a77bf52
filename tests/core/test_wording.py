"""Lists in sentences."""

from astra_data.core.naming import first_few, in_code, in_lines, in_markdown, printable, shortened


def test_as_many_as_are_shown_are_all_named() -> None:
    """The last that fits isn't counted."""
    assert first_few(["a", "b", "c"], 3) == "a, b, c"


def test_others_are_counted() -> None:
    """Numbers are named as they are."""
    assert first_few((3, 1, 4, 1, 5), 2) == "3, 1 and 3 more"


def test_of_nothing_nothing_is_said() -> None:
    """No separator stands alone."""
    assert first_few([], 2) == ""


def test_a_long_text_is_cut_and_says_so() -> None:
    """One that fits stays as it is."""
    assert shortened("grounding", 9) == "grounding"
    assert shortened("grounding", 8) == "groundin…"


def test_no_name_controls_a_terminal() -> None:
    """Colors, titles, links, lines of its own, or letters that run backwards."""
    name = "a\x1b[31mb\x1b]0;title\x07c\rd\ne\x9b\u202ef ä 腕"
    assert printable(name) == "a\ufffd[31mb\ufffd]0;title\ufffdc\ufffdd\ufffde\ufffd\ufffdf ä 腕"


def test_no_name_in_a_message_begins_a_message() -> None:
    """All lines but the first are indented, once."""
    assert in_lines("no field 'a\nfinished: b\x1b':\n  c") == "no field 'a\n  finished: b\ufffd':\n  c"


def test_no_name_is_more_than_words_in_markdown() -> None:
    """Neither tag nor heading, link or code."""
    text = "run\n# fast <script>alert(1)</script> [a](b) `c` x_1"
    shown = r"run # fast &lt;script&gt;alert(1)&lt;/script&gt; \[a\](b) \`c\` x_1"
    assert in_markdown(text) == shown
    assert in_code("a`b\n```c") == "`a'b " + 3 * "'" + "c`"
