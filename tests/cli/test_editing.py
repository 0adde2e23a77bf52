from pathlib import Path

import pytest
from command_line import call, output_of
from fake_dataset import DESCRIPTION, write_fake

from astra_data.core.errors import BadInputError
from astra_data.dataset.edit import subset
from astra_data.dataset.versions import open_dataset, versions_at_home


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path))
    write_fake(tmp_path / "fake/data-1.0.0", subset_seed=3)
    return "fake@data-1.0.0"


def test_every_edit_is_the_next_version_at_home(fake: str, tmp_path: Path) -> None:
    assert "(fake@data-1.1.0, 2 episodes, " in output_of(
        "subset", fake, "--percent", "40", "--stratify", "success"
    )
    assert "(fake@data-1.2.0, 3 episodes, " in output_of("filter", fake, "--without", "13", "--without", "0")
    assert "(fake@data-1.3.0, 2 episodes, " in output_of("filter", fake, "--success")
    assert "(fake@data-1.4.0, 3 episodes, " in output_of("filter", fake, "--no-success")
    assert "(fake@data-1.4.0, 5 episodes, 55 " in output_of(
        "merge", "fake@data-1.3.0", "fake@data-1.4.0", "--out", str(tmp_path / "here")
    )
    assert open_dataset(tmp_path / "here").verify() == []
    assert len(versions_at_home("fake")) == 5


def test_an_edit_tells_what_the_name_means_from_now_on(fake: str, tmp_path: Path) -> None:
    note = "note: fake now means this version, no longer data-1.0.0; --name keeps both apart\n"
    assert output_of("subset", fake, "--percent", "40").endswith(note)
    for apart in (("--name", "part"), ("--out", str(tmp_path / "here"))):
        assert "note" not in output_of("subset", fake, "--percent", "40", *apart)
    write_fake(tmp_path / "fake/data-2.0.0", description={**DESCRIPTION, "version": "2.0.0"})
    # Of an older version, it is not the newest.
    assert "(fake@data-1.2.0, 2 episodes, " in (output := output_of("subset", fake, "--percent", "40"))
    assert "note" not in output


def test_episodes_are_those_between_the_bounds_and_of_the_stored_order(fake: str, tmp_path: Path) -> None:
    def uids(*arguments: str) -> list[int]:
        out = tmp_path / "-".join(arguments)
        output_of(*arguments[:1], fake, *arguments[1:], "--out", str(out))
        return [int(uid) for uid in open_dataset(out).uids]

    # Returns are half the uids; lengths are 7, 1, 12, 30 and 5.
    assert uids("filter", "--min-return", "2", "--max-return", "3") == [4, 6]
    assert uids("filter", "--min-length", "5", "--max-length", "12") == [13, 2**53 + 1, 0]
    stored = subset(open_dataset(fake), episodes=3, out=tmp_path / "stored")
    taken = uids("subset", "--episodes", "3")
    assert taken == open_dataset(stored).uids.tolist()
    assert taken != uids("subset", "--episodes", "3", "--seed", "0")


def test_a_refused_edit_writes_nothing(fake: str) -> None:
    result = call("filter", fake, "--without", "1")
    assert isinstance(result.exception, BadInputError)
    assert len(versions_at_home("fake")) == 1


def test_a_recipe_says_its_sizes_itself() -> None:
    result = call("subset", "r.toml", "--percent", "50")
    assert str(result.exception) == "subset: the recipe's [sweep] sets this: leave out --percent"
    result = call("subset", "fake", "--percent", "50", "--seed", "0", "--seed", "1")
    assert isinstance(result.exception, BadInputError)
