"""Windows of paired episodes, which the grounding model learns from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.seeding import held_out_episodes
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Array
from astra_data.dataset.inspection import stands_still
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.worlds.commands import Commands
from astra_data.worlds.task import Task

BINS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # edges of the probabilities in a reliability diagram
RISK_STEPS = 20  # steps before each failure that `PairedWindows.fails_soon` marks
_LONG_STEPS, _LONG_RATIO = 2000, 8  # episodes of over so many steps, and over so many times the mean, are cut
_COLUMNS = (
    *(names.STATE, names.ACTION, names.TERMINATED),
    *(names.ABSTRACT_STATE, names.ABSTRACT_NEXT_STATE, names.ABSTRACT_SIMULATED_NEXT_STATE),
)


@dataclass(frozen=True)
class PairedWindows:
    """B windows of T steps each from paired episodes."""

    state: Tensor  # φ(s_i), (B, T, X)
    action: Tensor  # a_i, (B, T, A)
    previous_action: Tensor  # a_{i-1}, (B, T, A)
    goal: Tensor  # (B, T, G)
    simulated_next: Tensor  # where the abstract simulator landed, (B, T, X)
    next_state: Tensor  # φ(s_{i+1}), (B, T, X)
    reward: Tensor  # r_i, (B, T)
    goes_on: Tensor
    """(B, T), 1 where R_pred learns the reward: where the step ends nothing, as simulators detect and pay what
    ends an episode; without a failure model, also where it fails."""
    failed: Tensor  # (B, T), 1 where the step ends in a failure that no abstract state shows, whatever it pays
    fails_soon: Tensor  # (B, T), 1 where the episode fails within `RISK_STEPS`; see also `failing`
    mask: Tensor  # (B, T), 1 on real steps, 0 on padding
    own_reward: Tensor | None = None
    """The task's own reward of the step on abstract states, (B, T); None where R_pred predicts no residual
    reward, `reward` less this."""


def before_failures(fails: Tensor, mask: Tensor, steps: int) -> Tensor:
    """Return 1 at the last `steps` real steps of each episode that fails (E,), by the mask (E, T), else 0."""
    left = mask.flip(1).cumsum(1).flip(1)
    return (fails[:, None] & mask.bool() & (left <= steps)).float()


def draw_steps(lengths: Tensor, count: int, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """Draw windows of `length` steps, each step equally likely, shifted inside their episodes, whose ends matter.

    Returns episodes (count, 1), steps (count, length), and which of them were drawn before the shift.
    """
    length = min(length, int(lengths.max()))
    beginnings = lengths + length - 1
    episodes = torch.multinomial(beginnings.float(), count, replacement=True)
    drawn = (torch.rand(count, device=episodes.device) * beginnings[episodes]).long() - (length - 1)
    first = drawn.clamp_min(0).minimum((lengths[episodes] - length).clamp_min(0))
    steps = first[:, None] + torch.arange(length, device=first.device)
    return episodes[:, None], steps, (steps >= drawn[:, None]) & (steps < drawn[:, None] + length)


@dataclass(frozen=True)
class PairedEpisodes:
    """E paired episodes, or pieces of those far longer than most, padded at the end to T steps."""

    target_state: Tensor  # s_i, or the inputs in its place, (E, T, S)
    terminated: Tensor  # (E, T) bool, the task ended there, in success or failure; not set by time-outs
    windows: PairedWindows  # everything else, (E, T, ...), with the mask of real steps
    reference: str  # name and version of the dataset
    content_hash: str
    has_rewards: bool  # otherwise they are 0 here
    uids: Tensor  # (E,) int64
    recordings: Tensor  # the number of the recording that each is, or is a copy of, (E,) int64
    held_out: Tensor | None = None  # those that the dataset marks as held out, (E,) bool; None if it marks none
    dropped_place: tuple[int, ...] = ()  # the entries of s_i with the robot's position, if φ drops all of them
    commands: Commands | None = None  # their bounds, where these are not ±1 in their own units

    @property
    def named(self) -> dict[str, str]:
        """The metadata of files made from these episodes: `dataset` and `hash`."""
        return {"dataset": self.reference, "hash": self.content_hash}

    @classmethod
    def load(
        cls, root: str | Path, device: str = "cpu", inputs: Sequence[str] = (), *, whole: bool = False
    ) -> "PairedEpisodes":
        """Read the paired dataset at `root`, actions as ±1; a last step that was made up joins the one before.

        The columns `inputs`, one after another, stand in for the target's state. Unless `whole`, episodes far
        longer than most come in pieces.
        """
        dataset = open_dataset(root)
        if names.ABSTRACT_STATE not in dataset.features:
            raise BadInputError(f"{root} has no column {names.ABSTRACT_STATE}: expected a dataset that was paired")
        known = {names.GOAL, names.REWARD, names.SUCCESS} & dataset.features.keys()
        columns = dataset.columns(list(dict.fromkeys([*_COLUMNS, *known, *inputs])))
        lengths: NDArray[np.int64] = dataset.lengths
        which: NDArray[np.intp] = np.arange(len(dataset))  # the episode that each piece is of
        if (made_up := _made_up(dataset, columns)).any():
            columns, lengths = _merged(columns, lengths, made_up)
            left = lengths > 0
            if not left.any():
                raise BadInputError(f"{root}: no step is left: each episode has one, whose next state was made up")
            lengths, which = lengths[left], which[left]
        if not whole:
            lengths, cut = _pieces(lengths)
            which = which[cut]
        bounds = dataset.description["simulator"].get("commands")
        commands = Commands({name: tuple(ends) for name, ends in bounds.items()}) if bounds else None
        padded = {}
        for name, values in columns.items():
            is_outcome = name in (names.TERMINATED, names.SUCCESS)  # of logs, it may be a number
            steps = torch.from_numpy(values.astype(bool if is_outcome else np.float32, copy=False))
            if name != names.REWARD and not is_outcome:
                steps = steps.reshape(len(steps), -1)
            if name == names.ACTION and commands is not None:
                steps = commands.normal(steps)
            padded[name] = torch.nn.utils.rnn.pad_sequence(steps.to(device).split(lengths.tolist()), batch_first=True)
        mask = torch.arange(lengths.max(), device=device) < torch.tensor(lengths, device=device)[:, None]
        action, terminated = padded[names.ACTION], padded[names.TERMINATED]
        reward = padded.get(names.REWARD, torch.zeros_like(terminated, dtype=action.dtype))
        failed = terminated & ~padded.get(names.SUCCESS, terminated)
        return cls(
            target_state=torch.cat([padded[name] for name in inputs or (names.STATE,)], dim=-1).float(),
            terminated=terminated,
            windows=PairedWindows(
                state=padded[names.ABSTRACT_STATE],
                action=action,
                previous_action=torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], dim=1),
                goal=padded.get(names.GOAL, action.new_empty(*mask.shape, 0)),
                simulated_next=padded[names.ABSTRACT_SIMULATED_NEXT_STATE],
                next_state=padded[names.ABSTRACT_NEXT_STATE],
                reward=reward,
                goes_on=(mask & ~terminated).float(),
                failed=failed.float(),
                fails_soon=before_failures(failed.any(1), mask, RISK_STEPS),
                mask=mask.float(),
            ),
            reference=dataset.reference,
            content_hash=dataset.content_hash,
            has_rewards=names.REWARD in padded,
            uids=torch.tensor(dataset.uids[which], device=device),
            recordings=torch.tensor(dataset.recordings[which], device=device),
            held_out=torch.tensor(held_out, device=device) if (held_out := dataset.held_out[which]).any() else None,
            dropped_place=() if inputs else _dropped_place(dataset),
            commands=commands,
        )

    def check(self, task: Task, *, needs_goals: bool = False) -> None:
        """Check that states, actions and goals, unless there are none and nothing needs them, are those of `task`."""
        faults = [
            f"has {found} values in {what}, {task.name} {expected}"
            for what, found, expected in (
                ("a state", self.target_state.shape[-1], task.state.size),
                ("an abstract state", self.windows.state.shape[-1], task.abstract_state.size),
                ("a goal", self.windows.goal.shape[-1], task.objective.goal_size),
                ("an action", self.windows.action.shape[-1], task.action.size),
            )
            if found != expected and (found or what != "a goal")
        ]
        if (self.commands or {}) != ({} if task.limits.are_normal else task.limits):
            within = dict(self.commands or {}) or "±1"
            faults.append(f"was paired for commands within {within}, {task.name} has {dict(task.limits)}")
        if faults:
            raise BadInputError(f"{self.reference} {'; '.join(faults)}: pair it again, with the simulator of this task")
        if needs_goals and task.objective.goal_size and not self.windows.goal.shape[-1]:
            raise BadInputError(f"{self.reference} lacks the goals of {task.name}: run `astra-data label` first")

    def __len__(self) -> int:
        return len(self.target_state)

    @property
    def lengths(self) -> Tensor:
        """The number of real steps of each episode, (E,)."""
        return self.windows.mask.sum(1).long()

    def select(self, episodes: Tensor) -> "PairedEpisodes":
        """Return the episodes `episodes` (n,)."""
        columns = ("target_state", "terminated", "uids", "recordings", "held_out")
        given = {name: values[episodes] for name in columns if (values := getattr(self, name)) is not None}
        return replace(self, windows=_gather(self.windows, episodes), **given)

    def split(self, held_out_share: float, seed: int) -> tuple["PairedEpisodes", "PairedEpisodes"]:
        """Split into training and held-out episodes: as marked, else a share of recordings, with copies."""
        if self.held_out is not None:
            if self.held_out.all():
                got = f"{len(self)} that augmentation held out: take a larger subset"
                raise BadInputError(f"{self.reference}: expected episodes to train on, got {got}")
            return self.select((~self.held_out).nonzero()[:, 0]), self.select(self.held_out.nonzero()[:, 0])
        names, each = self.recordings.unique(return_inverse=True)
        training, held_out = divided(self.reference, len(names), held_out_share, seed)
        return self._of_recordings(each, training), self._of_recordings(each, held_out)

    def _of_recordings(self, each: Tensor, chosen: NDArray[np.intp]) -> "PairedEpisodes":
        """Return the episodes whose recordings, of which `each` (E,) has the number, are `chosen` (n,)."""
        place = each.new_full((int(each.max()) + 1,), len(chosen))
        place[torch.from_numpy(chosen).to(each.device)] = torch.arange(len(chosen), device=each.device)
        places, order = place[each].sort(stable=True)
        return self.select(order[places < len(chosen)])

    def steps(self, values: Tensor) -> Tensor:
        """Return the real steps of `values` (E, T, ...), one after another, (N, ...)."""
        return values[self.windows.mask.bool()]

    def draw_windows(self, count: int, length: int) -> tuple[PairedWindows, Tensor]:
        """Draw windows, masked to the drawn steps, and their target states (count, length, S)."""
        episodes, steps, is_drawn = draw_steps(self.lengths, count, length)
        windows = _gather(self.windows, (episodes, steps))
        return replace(windows, mask=windows.mask * is_drawn), self.target_state[episodes, steps]


def divided(
    reference: str, recordings: int, held_out_share: float, seed: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the numbers of the recordings of the dataset `reference` to train on, and of those held out."""
    training, held_out = held_out_episodes(recordings, held_out_share, seed)
    if not len(training):
        raise BadInputError(
            f"{reference}: recorded episodes: {recordings}, of which {len(held_out)} would be held out, and "
            "none is left to train on: record more, or make held_out_share smaller"
        )
    return training, held_out


def _made_up(dataset: Dataset, columns: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return which episodes (E,) end with a terminated step whose next state is its own, to the bit."""
    last = dataset.lengths.cumsum() - 1
    ended = np.flatnonzero(columns[names.TERMINATED][last])
    made_up = np.zeros(len(dataset), dtype=bool)
    if names.NEXT_STATE in dataset.features and len(ended):
        after = dataset.columns([names.NEXT_STATE], ended.tolist())[names.NEXT_STATE]
        after = after[dataset.lengths[ended].cumsum() - 1]
        made_up[ended] = [*map(stands_still, columns[names.STATE][last[ended]], after)]
    return made_up


def _merged(
    columns: Mapping[str, Array], lengths: NDArray[np.int64], merged: NDArray[np.bool_]
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Merge the last step of the episodes `merged` (E,) into the one before; return what is left."""
    last = (lengths.cumsum() - 1)[merged & (lengths > 1)]
    left = dict(columns)
    for name in {names.REWARD, names.TERMINATED, names.SUCCESS} & left.keys():
        values = left[name].copy()
        values[last - 1] += values[last]
        left[name] = values
    kept = np.ones(int(lengths.sum()), dtype=bool)
    kept[(lengths.cumsum() - 1)[merged]] = False
    return {name: values[kept] for name, values in left.items()}, lengths - merged


def _pieces(lengths: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return the lengths of the pieces of episodes, and which episode each is of; a long one would pad all others."""
    longest = max(_LONG_STEPS, int(_LONG_RATIO * lengths.mean()))
    counts = -(-lengths // longest)
    pieces = np.full(counts.sum(), longest)
    pieces[counts.cumsum() - counts] = lengths - (counts - 1) * longest  # the first is the short one, as ends matter
    return pieces, np.repeat(np.arange(len(lengths)), counts)


def _dropped_place(dataset: Dataset) -> tuple[int, ...]:
    columns = {column.name: column for column in dataset.schema}
    roles = columns[names.ABSTRACT_STATE].roles
    if not roles or "position" in dict(roles):
        return ()
    groups = [group for role, group in columns[names.STATE].roles if role == "position"]
    return tuple(index for group in groups for index in range(group.start, group.stop))


def _gather(windows: PairedWindows, rows: Tensor | tuple[Tensor, Tensor]) -> PairedWindows:
    given = {name: values for name, values in vars(windows).items() if values is not None}
    return PairedWindows(**{name: values[rows] for name, values in given.items()})
