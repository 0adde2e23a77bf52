import torch

from astra_data.studies.motion import between, chained, composed, seen_after


def poses(count: int, seed: int) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_composing_undoes_taking_apart() -> None:
    before, after = poses(20, 0), poses(20, 1)
    wrong = between(after, composed(before, between(before, after)))
    torch.testing.assert_close(wrong, torch.zeros_like(wrong))


def test_a_chain_is_its_links_composed() -> None:
    links = poses(12, 2).reshape(3, 4, 3)
    place = torch.zeros(3, 3, dtype=torch.float64)
    for step in range(4):
        place = composed(place, links[:, step])
        torch.testing.assert_close(chained(links)[:, step], place)


def test_a_resting_point_stays_in_the_field() -> None:
    point = torch.tensor([[2.0, 1.0]])
    quarter = torch.tensor([[1.0, 0.0, torch.pi / 2]])
    torch.testing.assert_close(seen_after(point, quarter), torch.tensor([[1.0, -1.0]]), atol=1e-6, rtol=0)
