"""The descriptor of methods: the parts of the pipeline that they use, their settings, how they are shown."""

from dataclasses import dataclass
from typing import Literal

from astra_data.core.config import Config
from astra_data.grounding.fit import Fit
from astra_data.grounding.simulator import FittedGrounding
from astra_data.policies.train import InSimulator, Learn

IN_RAW_SIMULATOR = InSimulator()

Source = Literal["simulator", "target", "episodes"]
"""What a policy learns from: steps of the abstract simulator or of the target, or recorded episodes alone."""

Role = Literal["floor", "ceiling", "trained there"]
"""Rows for comparison: no grounding at all; a hand-written controller; a policy trained in the target itself,
which may learn less from the same number of steps."""


@dataclass(frozen=True)
class Table:
    """A table of settings in a recipe, which one method or several read."""

    name: str
    model: type[Config]


@dataclass(frozen=True)
class Method:
    """A method, which is one row of the results: `name` in recipes and folders, `title` in tables and figures.

    Attributes:
        color: in figures, as "#rrggbb"; one of the spare colors where empty.
        role: set for rows that the others are compared with.
        fit: what it learns about the simulator from pairs; None where the simulator stays raw.
        learn: how it learns its policy; None where there is none to learn. learns_from: from what.
        aligns: whether a target encoder is fitted for deployment.
        initial: the method from whose policy its own training starts, if any.
        grounded_as: the method whose grounding and alignment it uses; its own where empty.
        grounding: the class of what its fit returns, where this is none of the package's.
        table: its settings in a recipe. configures: the stage that takes them.
        planar: whether it is for tasks in a maze only.
    """

    name: str
    title: str
    color: str = ""
    role: Role | None = None
    fit: Fit | None = None
    learn: Learn | None = IN_RAW_SIMULATOR
    learns_from: Source = "simulator"
    aligns: bool = False
    initial: str | None = None
    grounded_as: str = ""
    grounding: type[FittedGrounding] | None = None
    table: Table | None = None
    configures: Literal["ground", "train"] = "train"
    planar: bool = False

    @property
    def grounds(self) -> bool:
        """Whether it fits something to pairs."""
        return self.fit is not None

    @property
    def trains(self) -> bool:
        """Whether there is a policy to train."""
        return self.learn is not None

    @property
    def in_simulator(self) -> bool:
        """Whether its policy is trained in the abstract simulator, so that it can have the plus settings."""
        return self.trains and self.learns_from == "simulator"

    @property
    def steps_target(self) -> bool:
        """Whether its policy is trained in the target itself."""
        return self.trains and self.learns_from == "target"

    @property
    def trains_without_target(self) -> bool:
        """Whether its policy is trained without the target, and so acts on abstract states."""
        return self.trains and self.learns_from != "target"
