from pathlib import Path

import pytest
from command_line import call
from fake_dataset import write_fake

from astra_data.core.errors import AstraDataError
from astra_data.dataset.versions import open_dataset
from astra_data.pipeline.stages.augment import AugmentConfig

pytestmark = pytest.mark.usefixtures("home")


def test_a_dataset_is_augmented_beside_itself(home: Path) -> None:
    call("collect", "antmaze-umaze", "--episodes", "3", "--max-steps", "6", "--name", "walks")
    options = ["--copies", "2", "--margin-m", "0.3", "--min-steps", "3", "--rotations", "none", "--seed", "5"]
    result = call("augment", "walks", "--task", "antmaze-umaze", *options)
    assert result.output.splitlines()[-1] == f"finished: {home / 'walks/data-1.1.0'}"
    dataset = open_dataset("walks")
    assert len(dataset) == 3 + 2 * 2
    assert dataset.description["config"] == AugmentConfig(
        copies=2, margin_m=0.3, min_steps=3, rotations="none"
    ).model_dump(mode="json")
    assert dataset.description["seeds"]["augment"] == 5


def test_every_setting_is_an_option() -> None:
    shown = call("augment", "--help").output
    for name in AugmentConfig.model_fields:
        assert f"--{name.replace('_', '-')}" in shown


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--copies", "2", "--episodes", "9"], "augment: episodes: expected either copies or episodes"),
        (["--rotations", "none", "--no-translations"], "augment: translations: expected rotations or transl"),
        (["--rotations", "half"], "augment: rotations: expected 'quarter', 'any' or 'none', got 'half'"),
        (["--held-out-share", "1"], "augment: held_out_share: expected"),
    ],
)
def test_what_does_not_fit_is_told(home: Path, tmp_path: Path, options: list[str], told: str) -> None:
    assert "no dataset 'walks'" in str(call("augment", "walks", *options).exception)
    error = call("augment", str(write_fake(tmp_path / "fake").root), *options).exception
    assert isinstance(error, AstraDataError)
    with pytest.raises(AstraDataError, match=told):
        raise error
    assert not home.exists()
