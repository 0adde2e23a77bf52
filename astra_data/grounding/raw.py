"""No grounding: the abstract simulator as it is."""

from dataclasses import dataclass

from astra_data.grounding.protocols import Grounding


@dataclass(frozen=True)
class NoGrounding(Grounding):
    """Leave the simulator as it is, except for varied parameters if given."""


NO_GROUNDING = NoGrounding()
