import torch
from toy_episodes import toy_episodes

from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator, Grounding
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.variation import VariedSimulator

TASK = TASKS["antmaze-umaze"]


def test_simulators_are_the_tasks_own() -> None:
    plain = NO_GROUNDING.simulator(TASK, 3)
    assert type(plain) is EpisodeSimulator and type(plain.simulator) is PointMass
    assert plain.state.shape == (3, 4)
    varied = NO_GROUNDING.simulator(TASK, 3, variation=TASK.varied.wide)
    assert isinstance(varied.simulator, VariedSimulator)


def test_nothing_is_remembered() -> None:
    episodes = toy_episodes(torch.zeros(1, 3, 4), torch.zeros(1, 3, 2), next_state=torch.zeros(1, 3, 4))
    grounding: Grounding = NO_GROUNDING
    assert grounding.hidden_before(episodes.windows) is None
    assert grounding.encoder is None
    assert NO_GROUNDING.for_replay() is NO_GROUNDING
