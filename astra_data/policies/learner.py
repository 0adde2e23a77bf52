"""What a learner of the user's makes; the base of those that act in an environment: seeded iterations, checkpoints."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, ClassVar, Protocol, Self

from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.seeding import derive
from astra_data.worlds.protocols import BatchedEnv, Step

_ROUNDING = 1e-9  # of a sum of shares
_ROWS = ("previous_action", "hidden", "first", "age", "lasted")  # what checkpoints hold of the rows


class ActingPolicy(Protocol):
    """What a policy of another learner has to have."""

    def act(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Return actions (B, A) within ±1 for observations (B, O) float32."""


class SavedPolicy(ActingPolicy, Protocol):
    """What a policy has to have that a learner of the user's makes for a row."""

    kind: ClassVar[str]  # names the class in files; see `KINDS`

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """Return tensors, at least one, and metadata (JSON values) from which `from_file` rebuilds it."""

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any]) -> Self:
        """Rebuild it."""


PACKAGE_KINDS = ("actor_critic", "adaptive", "soft_actor")  # what files call the networks of the package
KINDS: dict[str, type[SavedPolicy]] = {}
"""The classes of such policies by their kinds, as methods of the user's add them."""


def add_policy_kind(made: type[SavedPolicy]) -> None:
    """Let files hold policies of another learner."""
    if made.kind in PACKAGE_KINDS or KINDS.setdefault(made.kind, made) is not made:
        advice = f"rename that of {made.__name__}"
        raise BadInputError(f"policies of kind '{made.kind}' are the package's or another learner's: {advice}")


class Learner(ABC):
    """A training in progress in B rows; iterations are seeded by their number, so that a resumed one repeats them."""

    def __init__(
        self,
        env: BatchedEnv,
        hidden: Tensor,
        parts: Mapping[str, Any],
        *,
        horizon: int,
        total_steps: int,
        rollout_steps: int,
        seed: int,
        is_staggered: bool = True,
    ) -> None:
        """Start all rows, with the policy's memory `hidden` (B, H); `parts` are all else that learning changes."""
        self.env, self.horizon = env, horizon
        self.total_steps, self.rollout_steps, self.steps = total_steps, rollout_steps, 0
        # Of the training that is done, which schedules follow; at a pace of 2 half of the steps that are left remain.
        self.share, self.pace = 0.0, 1.0
        self._parts, self._seed, self._iteration = parts, seed, 0
        self.observation = env.reset()  # to act on next
        device = self.observation.device
        self.previous_action = torch.zeros(env.num_envs, env.action_size, device=device)
        self.hidden = hidden
        self.first = torch.ones(env.num_envs, dtype=torch.bool, device=device)  # whether an episode begins with it
        self.lasted = torch.zeros(env.num_envs, dtype=torch.int64, device=device)
        self.age = torch.randint_like(self.lasted, horizon) if is_staggered else self.lasted
        self._forget()

    def _forget(self) -> None:
        self._taken = self._finished = self._succeeded = self._survived = self._rewarded = 0.0

    def take(self, action: Tensor, hidden: Tensor) -> tuple[Step, Tensor, Tensor, Tensor]:
        """Apply `action` (B, A), keep `hidden` (B, H), and reset the rows that are done.

        Return the step, the action clipped to ±1, and which rows (B,) reached the horizon, and which ended.
        """
        step = self.env.step(action)
        self.age, self.lasted = self.age + 1, self.lasted + 1
        expired = (self.age >= self.horizon) & ~step.terminated
        done = step.terminated | expired
        self._taken += 1
        self._finished += float(done.sum())
        self._succeeded += float(step.success.sum())
        self._survived += float(self.lasted[done].sum())
        self._rewarded += float(step.reward.mean())
        self.age, self.lasted = (torch.where(done, 0, steps) for steps in (self.age, self.lasted))
        self.observation = self.env.reset(done) if bool(done.any()) else step.observation
        executed, going = action.clamp(-1.0, 1.0), (~done).float().unsqueeze(-1)
        self.previous_action, self.hidden, self.first = executed * going, hidden * going, done
        return step, executed, expired, done

    def figures(self) -> dict[str, float]:
        """Return means on the steps since the last call: success and steps of the episodes that ended, the reward."""
        ended = self._finished or math.nan
        figures = {"success": self._succeeded / ended, "episode_steps": self._survived / ended}
        figures |= {"episodes": self._finished, "reward": self._rewarded / self._taken}
        self._forget()
        return figures

    @property
    def done(self) -> bool:
        """Whether the training is over."""
        return self.share >= 1.0 - _ROUNDING

    def iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps and learn; return `figures`, and the learner's own."""
        torch.manual_seed(derive(self._seed, f"iteration {self._iteration}"))
        figures = self._iterate()
        taken = self.env.num_envs * self.rollout_steps
        self.steps += taken
        self.share = min(1.0, self.share + self.pace * taken / self.total_steps)
        self._iteration += 1
        return self.figures() | figures

    @abstractmethod
    def _iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps and learn; return metrics."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything but the environment's own state; see `load_state_dict`."""
        progress = {"steps": self.steps, "share": self.share, "iteration": self._iteration}
        rows = {name: getattr(self, name) for name in _ROWS}
        return {name: part.state_dict() for name, part in self._parts.items()} | progress | {"rows": rows}

    def load_state_dict(self, state: dict[str, Any], observation: Tensor, *, goes_on: bool = True) -> None:
        """Continue from `state`, once the environment is restored and returned `observation` (B, O), or start anew."""
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.steps, self.share, self._iteration = state["steps"], state["share"], state["iteration"]
        self.observation = observation
        if not goes_on:
            self._cut()
            return
        for name in _ROWS:
            setattr(self, name, state["rows"][name].to(observation.device))

    def _cut(self) -> None:  # noqa: B027 - most keep nothing
        """Let what comes next follow no step that was kept."""


Points = Sequence[Mapping[str, float | None]]

_RECENT = 5  # points of the learning curve over which figures are averaged
_NEARLY_ALWAYS = 0.95  # success of training episodes from which on little is left to learn
_FAST = 6.0  # pace of a training then
_GROWTH_SHARE = 0.25  # share of the training over which penalties grow; from the start, they teach robots to stand
_PATIENCE_SHARE = 0.4  # share of the training after which they wait for no more than a mastered simulator


def recent(points: Points, figure: str = "success") -> float | None:
    """Return the mean of a `figure` of the last training episodes; None if none has ended."""
    known = [value for point in points[-_RECENT:] if (value := point.get(figure)) is not None]
    return fmean(known) if known else None


def pace(points: Points, penalties: float) -> float:
    """Return how fast to go on after `points`: faster where little is left to learn, with all penalties."""
    return _FAST if penalties == 1.0 and (recent(points) or 0.0) >= _NEARLY_ALWAYS else 1.0


def penalty_scale(points: Points, mastered: float) -> float:
    """Return the factor on penalties, 0 to 1: grows while nearly all succeed, later if `mastered` do, else falls."""
    scale, before = 0.0, 0.0
    for number, point in enumerate(points, 1):
        now = float(point["share"] or 0.0)
        change = (now - before) / _GROWTH_SHARE
        needed = _NEARLY_ALWAYS if now < _PATIENCE_SHARE else mastered
        scale += change if (recent(points[max(0, number - _RECENT) : number]) or 0.0) >= needed else -change
        scale, before = min(1.0, max(0.0, scale)), now
    return scale


def lately(points: Points, figure: str) -> str:
    """Return a note of the mean of a `figure`, "success" or "episode_steps", over the last `points`."""
    name, digits = ("success", ".2f") if figure == "success" else ("steps", ",.0f")
    mean = recent(points, figure)
    return f"{name} of training episodes {'unknown yet' if mean is None else format(mean, digits)}"
