from astra_data.core.seeding import derive, fresh_seed, generator, held_out_episodes


def test_streams_are_the_same_on_every_machine() -> None:
    assert derive(0, "collect") == 8832000878795479372
    assert list(generator(0, "collect").integers(0, 100, 5)) == [26, 26, 5, 6, 67]


def test_seeds_and_purposes_give_different_streams() -> None:
    seeds = {derive(seed, purpose) for seed in range(100) for purpose in ("a", "b", "1", "11")}
    assert len(seeds) == 400 and all(0 <= seed < 2**63 for seed in seeds)


def test_episodes_are_held_out_as_many_as_asked_for_and_at_least_one() -> None:
    for share, count in ((0.0, 0), (0.01, 1), (0.25, 5), (1.0, 20)):
        training, held_out = held_out_episodes(20, share, seed=3)
        assert len(held_out) == count and sorted([*training, *held_out]) == list(range(20))
    same, other = (held_out_episodes(20, 0.25, seed)[1].tolist() for seed in (3, 4))
    assert held_out_episodes(20, 0.25, 3)[1].tolist() == same != other


def test_a_seed_that_nobody_gave_is_another_each_time() -> None:
    seeds = {fresh_seed() for _ in range(5)}
    assert len(seeds) == 5 and all(0 <= seed < 2**63 for seed in seeds)
