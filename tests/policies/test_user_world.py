"""A policy in the simulator that it was trained in."""

import pytest
from constant_policy import Constant
from small_cart import TASK

from astra_data.core.errors import BadInputError
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.episodes import reached_in_own_world
from astra_data.policies.running_policy import PolicyFile, UserPolicy
from astra_data.policies.simulator_env import Simulation, WorldConfig

SIMULATION = Simulation(WorldConfig())


def constant(command: float, simulation: Simulation = SIMULATION) -> PolicyFile:
    return PolicyFile(UserPolicy(Constant(command), 2, 1), simulation, None, None)


def test_what_it_reaches_is_what_the_simulator_s_rule_says() -> None:
    """Forward at 0.4 m a step, goals from 1 to 2 m, uniform: 3, 4 or 5 steps; 4.2 on average."""
    reached = reached_in_own_world(TASK, constant(1.0), NO_GROUNDING, seed=0)
    assert reached.success == 1.0 and reached.steps == pytest.approx(4.2, abs=0.2)
    # At 0.4 m/s goals up to 1.6 m are in reach in 4 s.
    some = reached_in_own_world(TASK, constant(-0.44), NO_GROUNDING, seed=0)
    assert some.success == pytest.approx(0.6, abs=0.15)
    assert some.steps == pytest.approx(32.5, abs=1.5)  # of those that arrive, in 25 to 40
    none = reached_in_own_world(TASK, constant(-1.0), NO_GROUNDING, seed=0)
    assert (none.success, none.steps) == (0.0, 40.0)
    assert reached_in_own_world(TASK, constant(-0.44), NO_GROUNDING, seed=1) != some


def test_a_policy_that_knows_no_simulator_cannot_be_tried() -> None:
    trained = PolicyFile(UserPolicy(Constant(1.0), 2, 1), None, None, None)
    with pytest.raises(BadInputError, match=r"tries: expected a policy that knows its simulator"):
        reached_in_own_world(TASK, trained, NO_GROUNDING, seed=0)
