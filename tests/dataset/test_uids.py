"""Uids of episodes that meet others of the same uid."""

from astra_data.dataset.columns import new_uid, renamed_metadata


def test_a_uid_that_nobody_has_is_kept() -> None:
    """It is the same episode after all."""
    assert new_uid(7, b"origin", {8, 9}) == 7


def test_a_uid_that_is_taken_is_replaced_by_one_that_is_free_and_fits_a_column() -> None:
    """It is 64 bits with a sign, and depends on where the episode comes from."""
    new = new_uid(7, b"origin", {7})
    assert new != 7
    assert 0 <= new < 2**63
    assert new == new_uid(7, b"origin", {7})
    assert new != new_uid(7, b"another", {7})
    assert new_uid(7, b"origin", {7, new}) not in {7, new}


def test_metadata_name_the_episodes_by_their_new_uids() -> None:
    """What a copy was made from is renamed with it; the uid that an episode had is kept beside."""
    names = {1: 11, 2: 2}
    assert renamed_metadata(1, {"angle": 0.5, "source_episode": 1}, names) == {
        "angle": 0.5,
        "source_episode": 11,
        "merged_uid": 1,
    }
    assert renamed_metadata(2, {"source_episode": 1}, names) == {"source_episode": 11}
    assert renamed_metadata(2, {"source_episode": 5}, names) == {"source_episode": 5}
    assert renamed_metadata(2, {}, names) == {}


def test_new_uids_are_below_two_to_the_63() -> None:
    assert all(0 <= new_uid(uid, b"origin", {uid}) < 2**63 for uid in range(64))
