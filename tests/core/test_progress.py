from astra_data.core.progress import part


def test_a_part_moves_its_part_of_the_whole() -> None:
    calls: list[tuple[float, str]] = []
    progress = part(lambda fraction, note: calls.append((fraction, note)), 0.5, 0.75)
    for fraction in (0.0, 0.5, 1.0):
        progress(fraction, "on it")
    assert calls == [(0.5, "on it"), (0.625, "on it"), (0.75, "on it")]
