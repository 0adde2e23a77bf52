"""The abstract simulator that episodes are run in: raw or varied; groundings correct its steps."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from astra_data.core.lazy import Tensor
from astra_data.grounding.paired_episodes import PairedWindows
from astra_data.worlds.commands import innermost
from astra_data.worlds.protocols import RememberingSimulator, TaskSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation, VariedSimulator

if TYPE_CHECKING:
    from astra_data.grounding.encoder import Encoder


PlacedSimulator = TaskSimulator | VariedSimulator  # whose states a correction may move after each step


class LatentEncoder(Protocol):
    """A network with a history encoder: the source encoder ψ^s, or the target encoder ψ^t."""

    encoder: "Encoder"

    def encoder_input(self, state: Tensor, goal: Tensor, previous_action: Tensor) -> Tensor:
        """Assemble the encoder's input (..., I) of states, goals and the actions that led there."""


class EpisodeSimulator:
    """B abstract simulators, varied ones redrawn for each episode; subclasses correct where they land."""

    latent_size: int = 0  # Z, of the latents that policies observe; 0 where there are none
    landed: Tensor  # where the simulator landed in the last step, before any correction, (B, X)
    hazard: Tensor | None = None  # the probability (B,) that the target failed in the last step; None where unknown

    def __init__(self, simulator: PlacedSimulator) -> None:
        self.simulator, self.landed = simulator, simulator.state
        self._varied = simulator if isinstance(simulator, VariedSimulator) else None
        inner = innermost(simulator)
        self._remembering = inner if isinstance(inner, RememberingSimulator) else None

    @property
    def state(self) -> Tensor:
        """The present abstract states, (B, X)."""
        return self.simulator.state

    @property
    def blocked(self) -> Tensor:
        """Which states were stopped at a wall in the last step, or by its correction, (B,) bool."""
        return self.simulator.blocked

    @property
    def latent(self) -> Tensor | None:
        """The latents (B, Z) of the histories so far; None where there are none."""
        return None

    @property
    def parameters(self) -> Tensor | None:
        """The varied parameters (B, P), from -1 to 1 over their ranges; None where they stay plain."""
        varied = self._varied
        return None if varied is None else varied.variation.normal(varied.parameters)

    def start(
        self,
        state: Tensor,
        rows: Tensor,
        goal: Tensor,
        *,
        hidden: Tensor | None = None,
        previous_action: Tensor | None = None,
    ) -> None:
        """Start episodes in `rows` (n,), new ones or within a history: `hidden` (n, H), `previous_action` (n, A)."""
        self.simulator.reset_to(state, rows)
        varied = self._varied
        if varied is not None:
            drawn = varied.variation.draw(len(rows), varied.parameters.device)
            varied.parameters = varied.parameters.index_copy(0, rows, drawn)

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the new states (B, X)."""
        self.landed = self.simulator.step(action)
        return self.landed

    def _settle(self, before: Tensor, corrected: Tensor) -> Tensor:
        """Move from `before` to `corrected` (B, X), as far as walls allow; return where that is."""
        return self.simulator.settle(before, corrected)

    def predicted_reward(self, own: Tensor) -> Tensor | None:
        """Return the target's reward (B,) as predicted, given the task's `own`; None where nothing does."""
        return None

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        state = {"state": self.state}
        if self._varied is not None:
            state |= {"true": self._varied.simulator.state, "parameters": self._varied.parameters}
        if self._remembering is not None:
            state["memory"] = self._remembering.memory
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.simulator.reset_to(state["state"])
        if self._varied is not None:
            self._varied.simulator.reset_to(state["true"].clone())
            self._varied.parameters = state["parameters"].clone()
        if self._remembering is not None:
            self._remembering.memory = state["memory"].clone()


class Grounding:
    """How an abstract simulator is corrected, if it is."""

    start_stride: ClassVar[int] = 1  # recorded steps between those that episodes may start from

    @property
    def encoder(self) -> LatentEncoder | None:
        """The source encoder ψ^s, whose latents policies observe; None where there are none."""
        return None

    def corrected(self, simulator: PlacedSimulator) -> EpisodeSimulator:
        """Wrap `simulator` in the correction."""
        return EpisodeSimulator(simulator)

    def simulator(
        self, task: Task, num_envs: int, device: str = "cpu", *, variation: Variation | None = None
    ) -> EpisodeSimulator:
        """Build `num_envs` abstract simulators of `task`, corrected; with a `variation`, their parameters vary."""
        if variation is None:
            return self.corrected(task.simulator(num_envs, device))
        return self.corrected(task.varied_simulator(num_envs, variation, device))

    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor | None:
        """Return its memory before each `every`-th step, (E, ceil(T / every), H); None if it has none."""
        return None

    def for_replay(self) -> "Grounding":
        """Return the grounding to replay recorded actions with: without noise of sensors and actions."""
        return self


class FittedGrounding(Grounding, ABC):
    """A grounding that was fitted to pairs, and can be saved."""

    kind: ClassVar[str]  # names the class in files; see `files.KINDS`

    @abstractmethod
    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """Return tensors, at least one, and metadata (JSON values) from which `from_file` rebuilds it."""

    @classmethod
    @abstractmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Rebuild it on `device`, with frozen parameters."""


NO_GROUNDING = Grounding()
