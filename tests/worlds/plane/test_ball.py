import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.robots.nao.kicking import ROLLING_M_S2, asks_to_kick, kick_away, knock, roll


def test_a_ball_rolls_as_even_friction_has_it_whatever_the_steps() -> None:
    position, velocity = torch.zeros(1, 2), torch.tensor([[0.6, 0.8]])
    for _ in range(10):
        position, velocity = roll(position, velocity, 0.1, ROLLING_M_S2)
    # v0 t - a t² / 2 after 1 s, along (0.6, 0.8).
    assert position[0].tolist() == pytest.approx([0.6 * 0.85, 0.8 * 0.85], abs=1e-5)
    assert velocity[0].tolist() == pytest.approx([0.6 * 0.7, 0.8 * 0.7], abs=1e-5)


def test_a_ball_comes_to_rest_where_its_energy_ends() -> None:
    position, velocity = roll(torch.zeros(1, 2), torch.tensor([[1.0, 0.0]]), 60.0, ROLLING_M_S2)
    assert position[0].tolist() == pytest.approx([1.0 / (2 * 0.3), 0.0], abs=1e-5)
    assert velocity.abs().max() == 0
    again, _ = roll(position, velocity, 1.0, ROLLING_M_S2)
    assert torch.equal(again, position)


def test_a_body_knocks_its_ball_away_along_the_line_between_them() -> None:
    before, after = torch.tensor([[0.0, 0.0]]), torch.tensor([[0.1, 0.0]])
    ball = torch.tensor([[0.2, 0.1]])
    place, velocity = knock(before, after, ball, torch.zeros(1, 2), reach_m=0.19, speed_m_s=0.7)
    diagonal = 0.5**0.5
    assert velocity[0].tolist() == pytest.approx([0.7 * diagonal, 0.7 * diagonal], abs=1e-6)
    assert place[0].tolist() == pytest.approx([0.1 + 0.19 * diagonal, 0.19 * diagonal], abs=1e-6)
    beside, turned = knock(
        before, after, ball, torch.zeros(1, 2), reach_m=0.19, speed_m_s=0.7, turn_rad=torch.pi / 4
    )
    # It begins where the body touches it, whichever way it leaves.
    assert torch.equal(beside, place)
    assert turned[0].tolist() == pytest.approx([0.0, 0.7], abs=1e-6)


def test_only_bodies_that_approach_knock_their_ball_wherever_they_are() -> None:
    before = torch.tensor([[2.0, -1.0], [2.0, -1.0], [2.0, -1.0]])
    after = before + torch.tensor([[0.02, 0.01], [-0.02, -0.01], [0.01, -0.02]])
    ball = after + torch.tensor([[0.12, 0.06], [0.12, 0.06], [0.12, 0.07]])
    _, velocity = knock(before, after, ball, torch.zeros(3, 2), reach_m=0.19, speed_m_s=0.7)
    # Toward the ball; away from it; a little away, nearly across.
    assert (velocity != 0).any(-1).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("after", "ball"),
    [([0.1, 0.0], [0.4, 0.0]), ([0.1, 0.0], [-0.05, 0.0]), ([0.0, 0.0], [0.1, 0.0])],
    ids=["out of reach", "behind", "standing"],
)
def test_other_balls_are_left_alone(after: list[float], ball: list[float]) -> None:
    rolling = torch.tensor([[0.1, 0.2]])
    place, velocity = knock(
        torch.zeros(1, 2), torch.tensor([after]), torch.tensor([ball]), rolling, reach_m=0.19, speed_m_s=0.7
    )
    assert torch.equal(place, torch.tensor([ball]))
    assert torch.equal(velocity, rolling)


def test_a_ball_at_the_very_place_of_its_body_is_nowhere_undefined() -> None:
    before, here, still = torch.tensor([[-0.1, 0.0]]), torch.zeros(1, 2), torch.zeros(1, 2)
    place, velocity = knock(before, here, here, still, reach_m=0.19, speed_m_s=0.7)
    asked = torch.ones(1, 1, dtype=torch.bool)
    kicked = kick_away(here, here, still, asked, reach_m=0.35, speed_m_s=2.0)
    for found in (place, velocity, kicked):
        assert torch.equal(found, still)


def test_a_kick_sends_balls_within_reach_straight_away() -> None:
    bodies = torch.zeros(4, 2)
    ball = torch.tensor([[0.18, 0.24], [0.18, 0.24], [0.3, 0.4], [-0.3, 0.0]])
    rolling = torch.tensor([[0.1, 0.2]]).expand(4, 2)
    asked = asks_to_kick(torch.tensor([[0.9, 0.9, 0.6], [0.9, 0.9, 0.5], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    velocity = kick_away(bodies, ball, rolling, asked, reach_m=0.35, speed_m_s=2.0)
    # Kicked; not asked to; out of reach; behind, which a body without a heading kicks as well.
    torch.testing.assert_close(velocity, torch.tensor([[1.2, 1.6], [0.1, 0.2], [0.1, 0.2], [-2.0, 0.0]]))
    turned = kick_away(
        bodies, ball, rolling, asked, reach_m=0.35, speed_m_s=2.0, turn_rad=torch.full((4,), torch.pi / 2)
    )
    torch.testing.assert_close(turned[[0, 3]], torch.tensor([[-1.6, 1.2], [0.0, -2.0]]))


def test_commands_without_a_wish_to_kick_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"expected commands of 3 values, .*, got 2: collect"):
        asks_to_kick(torch.zeros(4, 2))
