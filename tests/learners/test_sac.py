import torch
from torch import nn
from toy_worlds import GoToZero

from astra_data.learners.sac import SacConfig, _Buffer, actor_network, train_sac

CONFIG = SacConfig(
    env_steps=2400, updates_per_step=3, batch_size=64, hidden_sizes=(32, 32), episode_steps=20, discount=0.9
)


def distance_after(network: nn.Sequential, steps: int) -> float:
    """Return how far from 0 the policy's mean action leaves points that start at ±1."""
    place = torch.tensor([[-1.0], [1.0]])
    with torch.no_grad():
        for _ in range(steps):
            action = torch.tanh(network(place)[:, :1])
            place = (place + 0.2 * action).clamp(-1.0, 1.0)
    return float(place.abs().max())


def test_learns_to_go_to_a_target() -> None:
    torch.manual_seed(0)
    start = actor_network(1, 1, (32, 32))
    assert distance_after(start, 10) > 0.5
    told: list[int] = []
    network = train_sac(
        GoToZero(16), CONFIG, seed=0, network=start, on_step=lambda steps, _: told.append(steps)
    )
    assert network is start
    assert distance_after(network, 10) < 0.15
    assert told == list(range(16, 2400 + 16, 16))


def test_the_buffer_keeps_the_most_recent() -> None:
    buffer = _Buffer(70, GoToZero(16))
    for batch in range(9):
        values = torch.full((16,), float(batch))
        buffer.add(values[:, None], -values[:, None], 10 * values, values[:, None] + 1, values > 6)
    drawn = buffer.sample(2000)
    observation = drawn["observation"]
    assert sorted(set(observation.flatten().tolist())) == [5.0, 6.0, 7.0, 8.0]
    assert torch.equal(drawn["action"], -observation)
    assert torch.equal(drawn["next", "reward"], 10 * observation)
    assert torch.equal(drawn["next", "observation"], observation + 1)
    assert torch.equal(drawn["next", "terminated"], observation > 6)
