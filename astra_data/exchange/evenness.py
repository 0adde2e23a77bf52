"""What is told of topics whose messages do not come as rows are taken."""

import math

MOST_UNEVEN = 0.05
"""Largest share of a topic's rows, steps or messages that are odd and not told."""
MISSED = 2.5
"""Silent for more of its periods, a topic has dropped out: two of its messages or more are missing."""
DUE = 0.75
"""Periods after a message from which on a row should hold the next one."""
_WHOLE = 0.005
"""Relative error of a measured rate that is taken for a whole number."""
_SMOOTH = 10
"""With so many messages a row, or more, one more or less changes a step too little to be told."""
_NEAR = 4
"""Rates of rows that are proposed are up to so many times as high or low as `fps`."""


def uneven_steps(topic: str, rate: float, fps: int) -> str:
    """Tell that `topic` comes `rate` times a second, of which `fps` is no whole fraction, and what to do.

    Nothing is told where so few steps are odd, or odd by so little, that it does not matter, nor where fewer
    messages come than rows.
    """
    whole = round(rate)
    if whole and abs(rate / whole - 1) < _WHOLE:
        rate = whole
    fewest, share_long = divmod(rate / fps, 1)
    if not 1 <= fewest < _SMOOTH or min(share_long, 1 - share_long) <= MOST_UNEVEN:
        return ""
    short, long = (f"{1000 * messages / rate:.0f}" for messages in (fewest, fewest + 1))
    near = range(math.ceil(fps / _NEAR), min(_NEAR * fps, whole) + 1)
    even = sorted((each for each in near if rate % each == 0), key=lambda each: abs(math.log(each / fps)))
    comes = f"{topic} comes {rate:.4g} times a second, of which"
    if even:
        *others, last = map(str, sorted(even[:3]))
        take = f"{', '.join(others)} or {last}" if others else last
        return (
            f"{comes} {fps} fps is no whole fraction: steps of {short} and {long} ms alternate; take {take}"
        )
    best = min(near, key=lambda each: (_share_odd(rate / each), abs(math.log(each / fps))))
    return (
        f"{comes} no fps nearby is a whole fraction: at {fps}, {share_long:.0%} of the steps are of "
        f"{long} ms, the others of {short}; at {best} only {_share_odd(rate / best):.0%} are odd, "
        "or publish it a whole number of times a second"
    )


def dropouts(topic: str, column: str, rate: float, fps: int, silences_ns: list[int], rows: int) -> str:
    """Tell that `topic` was silent, and the `gap_s` of its `column` that ends episodes there.

    Args:
        topic: the topic.
        column: a column of the mapping that it gives values to.
        rate: how often it usually comes in a second.
        fps: rows in a second.
        silences_ns: how long it was silent, each time.
        rows: how many rows repeat its message meanwhile.
    """
    places = f"in {len(silences_ns)} places" if len(silences_ns) > 1 else "once"
    # A message that a row repeats is at least 1 / fps - 1 / rate old, of topics that come more often.
    gap_ms = math.floor(1000 * max(2 / rate, 1 / fps - 1 / rate))
    repeat = f"{rows} rows repeat" if rows > 1 else "a row repeats"
    return (
        f"{topic} is silent for up to {max(silences_ns) / 1e9:.2g} s {places}, where {repeat} its message "
        f'before: gap_s = {gap_ms / 1000:g} in [columns."{column}"] ends episodes there'
    )


def ended(topic: str, times: int, gap_s: float, column: str, commanded: str | None) -> str:
    """Tell that `topic` ended episodes, and what to do where that is not right.

    Args:
        topic: the topic.
        times: how often it was silent for too long, and others were not.
        gap_s: the longest silence that is no end.
        column: the column whose own `gap_s` that is; "" if it is that of `split`.
        commanded: the column of commands that the topic gives values to, if any.
    """
    key = f'gap_s in [columns."{column}"]' if column else "split.gap_s"
    often = "once" if times == 1 else f"{times} times"
    silence = (
        f"{topic} is silent for over {gap_s:g} s ({key}) {often} while others are not; episodes end there"
    )
    # A column with a gap of its own cannot be latched.
    if commanded:
        latched = "" if column else f'latched = true in [columns."{commanded}"], or '
        return (
            f"{silence}. That is right if the robot stops by itself without commands; if it continues with "
            f"the last one, set {latched}a longer gap_s"
        )
    if column:
        return f"{silence}; if values may be held for longer, set a longer one"
    return f"{silence}: set latched = true if it is sent on change, or a longer gap_s"


def _share_odd(messages_per_row: float) -> float:
    """Return the share of the rows that have one message more, or less, than most."""
    return abs(messages_per_row - round(messages_per_row))
