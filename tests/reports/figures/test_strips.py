import numpy as np

from astra_data.reports.figures.strips import Strip, strips


def test_strips_have_a_picture_for_each_moment_until_the_end() -> None:
    pictures = np.zeros((3, 8, 6, 3), dtype=np.uint8)
    figure = strips(
        (0.0, 1.0, 5.0),
        {"nas": Strip(pictures[:2], ended_s=1.34, failed=True), "astra": Strip(pictures, 5.0, failed=False)},
    )
    figure.canvas.draw()
    assert [len(axes.images) for axes in figure.axes] == [1, 1, 0, 1, 1, 1]
    assert [axes.get_title() for axes in figure.axes[:3]] == ["0 s", "1 s", "5 s"]
    texts = [[text.get_text() for text in axes.texts] for axes in figure.axes[::3]]
    assert texts == [["NAS", "fell after 1.3 s"], ["ASTRA", "5 s"]]
