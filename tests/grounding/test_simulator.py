import torch

from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass

TASK = TASKS["antmaze-umaze"]
HERE = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])


def simulator(count: int) -> EpisodeSimulator:
    one = EpisodeSimulator(PointMass(U_MAZE, count, timestep_s=0.05))
    one.start(HERE.expand(count, 4), torch.arange(count), torch.zeros(count, 2))
    return one


def varied(count: int) -> EpisodeSimulator:
    return NO_GROUNDING.simulator(TASK, count, variation=TASK.varied.wide)


def test_it_is_the_simulator_itself() -> None:
    raw = PointMass(U_MAZE, 1, timestep_s=0.05)
    raw.reset_to(HERE)
    one = simulator(1)
    for _ in range(10):
        action = torch.tensor([[0.3, 0.9]])
        state = raw.step(action)
        assert torch.equal(one.step(action), state)
        assert torch.equal(one.state, state)
        assert torch.equal(one.blocked, raw.blocked)


def test_a_start_draws_the_parameters_of_its_rows_anew() -> None:
    torch.manual_seed(0)
    one = varied(4)
    before = one.parameters
    assert before is not None and before.abs().max() <= 1.0
    one.start(HERE, torch.tensor([2]), torch.zeros(1, 2))
    after = one.parameters
    assert after is not None
    names = TASK.varied.wide.names
    drawn = [names.index(name) for name in ("friction", "heading_bias_deg", "timestep_scale")]
    assert (after[2, drawn] != before[2, drawn]).all()
    assert torch.equal(after[[0, 1, 3]], before[[0, 1, 3]])
    # From -1 at the lower to 1 at the upper end.
    friction = after[:, names.index("friction")]
    low, high = TASK.varied.wide.friction  # type: ignore[attr-defined]
    inner = one.simulator.parameters[:, names.index("friction")]  # type: ignore[attr-defined]
    torch.testing.assert_close(friction, (inner - low) / (high - low) * 2 - 1, atol=1e-5, rtol=0)


def test_a_saved_state_goes_on_with_its_parameters() -> None:
    torch.manual_seed(0)
    first, second = varied(3), varied(3)
    first.start(HERE.expand(3, 4), torch.arange(3), torch.zeros(3, 2))
    first.step(torch.ones(3, 2))
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    assert saved.keys() == {"state", "true", "parameters"}
    second.load_state_dict(saved)
    assert first.parameters is not None and second.parameters is not None
    assert torch.equal(second.parameters, first.parameters)
    for _ in range(3):
        states = []
        for one in (first, second):
            torch.manual_seed(1)
            states.append(one.step(torch.tensor([[0.5, -1.0]]).expand(3, 2)))
        assert torch.equal(*states)
    assert torch.equal(saved["parameters"], first.state_dict()["parameters"])


def test_a_saved_state_holds_what_a_simulator_remembers() -> None:
    walker = TASKS["humanoid-walker2d"]
    one = EpisodeSimulator(walker.simulator(2))
    assert simulator(1).state_dict().keys() == {"state"}
    assert one.state_dict().keys() == {"state", "memory"}
    memory = torch.rand_like(one.state_dict()["memory"])
    one.load_state_dict(one.state_dict() | {"memory": memory})
    assert torch.equal(one.state_dict()["memory"], memory)
