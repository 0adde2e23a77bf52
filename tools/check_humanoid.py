"""Why policies of the humanoid fall: in which direction, whether the grounding predicts it, what φ allows.

    uv run python tools/check_humanoid.py runs/humanoid_walker2d --seed 0

reads a finished run and prints

1. how long a humanoid lasts whose legs are commanded to stay straight;
2. the lean of humanoids some steps before they fall, in held-out recorded episodes and under the policies
   of rows, and the height that NAS's simulator, if its state has one, predicts for the fall from the true
   history and actions;
3. how long a recurrent policy on φ alone lasts that was taught by Full Obs on the states that it gets into
   itself (DAgger: Ross et al. 2011): up to there, what φ leaves out is no obstacle.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, pstdev
from typing import Annotated

import torch
import typer
from door import run_tool
from torch import Tensor, nn

from astra_data.experiments.trained_policy import load_policy, settings_of
from astra_data.grounding.files import GROUNDING, load_history_model
from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.history import HistoryEncoder, mlp
from astra_data.training.running_policy import target_observation
from astra_data.worlds.humanoid.model import CommandRanges
from astra_data.worlds.humanoid.target import HumanoidEnv
from astra_data.worlds.registry import task_named
from astra_data.worlds.rotation import rotation
from astra_data.worlds.task import Task

ROWS = ("behavior_cloning", "nas", "astra", "nas_plus", "astra_plus")
HUMANOIDS = 32
HORIZON = 1000
BEFORE_FALL = (10, 20, 40)
WINDOW, BURN_IN = 64, 16

Act = Callable[[Tensor], Tensor]
"""From target states (B, S) to actions (B, A)."""


@dataclass(frozen=True)
class Walk:
    """An episode: target states before each action, (T, S), and actions (T, A)."""

    state: Tensor
    action: Tensor
    fell: bool


def no_goals(count: int) -> Tensor:
    """Return goals (count, 0): a humanoid has none."""
    return torch.zeros(count, 0)


def row_acts(run: Path, row: str, seed: int, count: int) -> Act:
    """Return the policy of `row` for `count` humanoids; latents come from the simulator's encoder."""
    policy = replace(load_policy(run, row, seed=seed), target_encoder=None)
    policy.start(count)
    return lambda state: policy.act(state, no_goals(len(state)))


def straight(state: Tensor) -> Tensor:
    """Return the actions (B, 4) that hold hips at 0 and knees at -2 degrees."""
    angles = torch.deg2rad(torch.tensor([0.0, -2.0] * 2))
    return CommandRanges().commands(angles).expand(len(state), -1)


@torch.no_grad()
def walks(act: Act, env: HumanoidEnv) -> list[Walk]:
    """Run one episode of each humanoid."""
    env.reset()
    active = torch.ones(env.num_envs, dtype=torch.bool)
    lengths = torch.zeros(env.num_envs, dtype=torch.long)
    states, actions = list[Tensor](), list[Tensor]()
    while active.any() and len(states) < HORIZON:
        states.append(env.state)
        actions.append(act(env.state))
        lengths += active
        active &= ~env.step(actions[-1], active).terminated
    each = zip(
        torch.stack(states, 1), torch.stack(actions, 1), lengths.tolist(), active.tolist(), strict=True
    )
    return [Walk(state[:length], action[:length], not stands) for state, action, length, stands in each]


def recorded(dataset: Path, held_out_share: float, seed: int) -> list[Walk]:
    """Return the episodes of `dataset` that `ground` holds out."""
    _, held_out = PairedEpisodes.load(dataset).split(held_out_share, seed)
    each = zip(
        held_out.target_state,
        held_out.windows.action,
        held_out.lengths.tolist(),
        held_out.terminated.any(1).tolist(),
        strict=True,
    )
    return [Walk(state[:length], action[:length], fell) for state, action, length, fell in each]


@torch.no_grad()
def foretold_heights(task: Task, falls: list[Walk], before: int, model: GroundingModel) -> Tensor:
    """Return the last height (n,) in m as the grounded simulator predicts it `before` steps ahead."""
    hidden, starts, previous = [], [], []
    for fall in falls:
        start = len(fall.state) - 1 - before
        seen = task.abstraction(fall.state[: start + 1])
        earlier = torch.cat([torch.zeros_like(fall.action[:1]), fall.action[:start]])
        _, memories = model.encoder(model.encoder_input(seen, no_goals(len(seen)), earlier)[None])
        hidden.append(memories[0, -2])
        starts.append(seen[-1])
        previous.append(earlier[-1])
    simulator = GroundedSimulator(task.simulator(len(falls)), model)
    rows = torch.arange(len(falls))
    simulator.start(
        torch.stack(starts),
        rows,
        no_goals(len(falls)),
        hidden=torch.stack(hidden),
        previous_action=torch.stack(previous),
    )
    for step in range(before, 0, -1):
        simulator.step(torch.stack([fall.action[-1 - step] for fall in falls]))
    return simulator.state[:, 0]


def print_falls(task: Task, name: str, walked: list[Walk], model: GroundingModel) -> None:
    """Print the lean of humanoids before they fall, and the height that the grounded simulator predicts."""
    all_falls = [walk for walk in walked if walk.fell]
    falls = [fall for fall in all_falls if len(fall.state) > max(BEFORE_FALL) + 1]
    print(f"{name}: {len(all_falls)} falls, {len(falls)} of them after {max(BEFORE_FALL) + 1} steps")
    if not falls:
        return
    last = torch.stack([fall.state[-1, 2] for fall in falls])
    for before in BEFORE_FALL:
        ahead, left, up = rotation(torch.stack([fall.state[-1 - before, 3:7] for fall in falls]))[:, 2].T
        roll, pitch = torch.atan2(left, up).abs().rad2deg(), -torch.asin(ahead).rad2deg()
        text = f"{before:2d} steps earlier: leans {roll.mean():4.1f} deg to a side, {pitch.mean():5.1f} ahead"
        if "height_m" in task.quantities:
            wrong = foretold_heights(task, falls, before, model) - last
            rmse = wrong.square().mean().sqrt()
            text += f"; height predicted for the fall: {wrong.mean():+.2f} m (RMSE {rmse:.2f})"
        print(f"  {text}", flush=True)


class Student(nn.Module):
    """A recurrent network on φ."""

    def __init__(self, task: Task, seen: int, actions: int) -> None:
        super().__init__()
        self.task = task
        self.actions = actions
        self.memory = HistoryEncoder(seen + actions, embedding_size=128, latent_size=128)
        self.head = mlp((seen + 128, 256, 256, actions))

    def forward(self, seen: Tensor, previous: Tensor) -> Tensor:
        """Return actions (B, T, A) for observations (B, T, O) and the actions before them."""
        return self._act(seen, self.memory(torch.cat([seen, previous], -1))[0])

    def _act(self, seen: Tensor, latent: Tensor) -> Tensor:
        return torch.tanh(self.head(torch.cat([seen, latent], -1)))

    def acts(self, count: int) -> Act:
        """Return this as a policy for `count` humanoids from their starts on."""
        hidden, previous = torch.zeros(count, 128), torch.zeros(count, self.actions)

        def act(state: Tensor) -> Tensor:
            nonlocal hidden, previous
            seen = observed(self.task, state)
            hidden = self.memory.step(torch.cat([seen, previous], -1), hidden)
            previous = self._act(seen, self.memory.latent(hidden))
            return previous

        return act


def observed(task: Task, state: Tensor) -> Tensor:
    """Return observations (B, O) of target states (B, S): φ, scaled as for all policies."""
    return target_observation(task, state, no_goals(len(state)), None, "abstract")


def lesson(task: Task, walk: Walk, teacher: Act) -> Tensor:
    """Return observation, previous action and the teacher's action, (T, O + A + A)."""
    before = torch.cat([torch.zeros_like(walk.action[:1]), walk.action[:-1]])
    return torch.cat([observed(task, walk.state), before, teacher(walk.state)], -1)


def drawn(lessons: list[Tensor], count: int) -> tuple[Tensor, Tensor]:
    """Return windows (count, WINDOW, O + A + A) of `lessons`, padded, and which of their steps count."""
    chances = torch.tensor([float(len(lesson)) for lesson in lessons])
    windows, mask = torch.zeros(count, WINDOW, lessons[0].shape[1]), torch.zeros(count, WINDOW)
    for row, chosen in enumerate(torch.multinomial(chances, count, replacement=True).tolist()):
        first = int(torch.randint(max(1, len(lessons[chosen]) - BURN_IN), ()))
        piece = lessons[chosen][first : first + WINDOW]
        windows[row, : len(piece)] = piece
        mask[row, BURN_IN if first else 0 : len(piece)] = 1.0
    return windows, mask


def teach(task: Task, teacher: Act, env: HumanoidEnv, rounds: int) -> None:
    """Teach a student on states of its own (DAgger), and print how long it lasts."""
    seen_size, action_size = observed(task, env.state).shape[-1], env.action_size
    student, lessons = Student(task, seen_size, action_size), list[Tensor]()
    optimizer = torch.optim.Adam(student.parameters())
    for number in range(rounds + 1):
        lived = walks(student.acts(env.num_envs) if number else teacher, env)
        lessons += [lesson(task, walk, teacher) for walk in lived]
        lasted, count = fmean(len(walk.state) for walk in lived), sum(map(len, lessons))
        print(
            f"{'student' if number else 'teacher'} lasts {lasted:.0f} steps; {count:,} lessons so far",
            flush=True,
        )
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * (1 - number / (rounds + 1))
        for _ in range(350):
            windows, mask = drawn(lessons, 48)
            seen, before, right = windows.split([seen_size, action_size, action_size], -1)
            wrong = (student(seen, before) - right).square().mean(-1)
            optimizer.zero_grad()
            ((wrong * mask).sum() / mask.sum()).backward()
            nn.utils.clip_grad_norm_(student.parameters(), 1.0)
            optimizer.step()


def main(
    run: Annotated[
        Path, typer.Argument(help="A finished run of a recipe of the humanoid, as runs/humanoid_walker2d.")
    ],
    seed: Annotated[int, typer.Option(help="One of the run's seeds, and that of all randomness here.")] = 0,
    rounds: Annotated[int, typer.Option(help="Rounds of teaching.")] = 40,
) -> None:
    """Print why policies of the humanoid fall."""
    recipe = settings_of(run)
    task = task_named(recipe["task"])
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    model = load_history_model(run / "ground" / "nas" / f"seed_{seed}" / GROUNDING)
    env = task.target(HUMANOIDS, seed=seed)
    assert isinstance(env, HumanoidEnv)
    stood = [float(len(walk.state)) for walk in walks(straight, env)]
    print(f"straight legs last {fmean(stood):.0f} ± {pstdev(stood):.0f} steps")
    print_falls(
        task,
        "recorded",
        recorded(run / "pair" / f"seed_{seed}", recipe["ground"]["held_out_share"], seed),
        model,
    )
    for row in ROWS:
        print_falls(task, row, walks(row_acts(run, row, seed, HUMANOIDS), env), model)
    teach(task, row_acts(run, "full_obs", seed, HUMANOIDS), env, rounds)


if __name__ == "__main__":
    run_tool(main)
