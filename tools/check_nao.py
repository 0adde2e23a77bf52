"""Check how the simulated NAO walks: speeds, lag, drift, falls, kicks, throughput. Prints Markdown.

    uv run python tools/check_nao.py
    uv run python tools/check_nao.py --only speeds --only lag --seed 1

Robots differ as `worlds.nao.traits.TraitSpread` says; speeds are the mean of 3.8 s after a start of 1.9 s.
"""

import time
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from itertools import cycle
from typing import Annotated

import numpy as np
import typer
from rich.progress import Progress, TaskID

from astra_data.core.arrays import Floats
from astra_data.reports.formatting import table
from astra_data.worlds.nao import BatchedNao, WalkLimits
from astra_data.worlds.nao.robot import CONTROL_STEP_S
from astra_data.worlds.plane.geometry import wrapped

Tick = Callable[[float], None]
"""Takes the fraction of a check that is done."""
COMMANDS = (
    (0.10, 0.0, 0.0),
    (0.20, 0.0, 0.0),
    (0.25, 0.0, 0.0),
    (-0.15, 0.0, 0.0),
    (0.0, 0.10, 0.0),
    (0.0, 0.20, 0.0),
    (0.0, 0.0, 0.5),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, 2.0),
    (0.15, 0.0, 0.5),
    (0.15, 0.08, 0.0),
)
AXES = ("forward", "sideways", "turn")


class Check(StrEnum):
    """The checks."""

    speeds = "speeds"
    lag = "lag"
    drift = "drift"
    falls = "falls"
    kicks = "kicks"
    throughput = "throughput"


def main(
    only: Annotated[list[Check] | None, typer.Option(help="Run only this check; may be repeated.")] = None,
    seed: Annotated[int, typer.Option(help="Of robots and commands.")] = 0,
    robots: Annotated[int, typer.Option(help="Number of robots for random commands and throughput.")] = 64,
) -> None:
    """Print one table per check."""
    checks: dict[Check, Callable[[Tick], str]] = {
        Check.speeds: lambda tick: speeds(seed, tick),
        Check.lag: lambda tick: lag(robots, seed, tick),
        Check.drift: lambda tick: drift(seed, tick),
        Check.falls: lambda tick: falls(robots, seed, tick),
        Check.kicks: lambda tick: kicks(seed, tick),
        Check.throughput: lambda tick: throughput(robots, seed, tick),
    }
    for check in only or list(Check):
        with Progress(transient=True) as progress:
            task = progress.add_task(check.value, total=1.0)
            text = checks[check](partial(shown, progress, task))
        print(f"## {check.value}\n\n{text}\n")


def shown(progress: Progress, task: TaskID, fraction: float) -> None:
    """Advance the progress bar of a check."""
    progress.update(task, completed=fraction)


def walked(nao: BatchedNao, command: Floats, kick: bool = False) -> Floats:
    """Step once; return the mean velocity in the robots' frames, (B, 3)."""
    before = nao.pose
    nao.step(command, kick=np.full(len(command), kick))
    moved = nao.pose - before
    turn = wrapped(moved[:, 2])
    cos, sin = np.cos(before[:, 2] + turn / 2), np.sin(before[:, 2] + turn / 2)
    forward, left = cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0]
    return np.asarray(np.stack([forward, left, turn], axis=1) / CONTROL_STEP_S)


def speeds(seed: int, tick: Tick) -> str:
    """Compare achieved with commanded speeds, eight robots per command."""
    each, steps, start = 8, 30, 10
    nao = BatchedNao(each * len(COMMANDS), seed=seed)
    command = np.repeat(np.array(COMMANDS), each, axis=0)
    seen = []
    for step in range(steps):
        seen.append(walked(nao, command))
        tick((step + 1) / steps)
    robots = np.mean(seen[start:], axis=0).reshape(len(COMMANDS), each, 3)
    rows = [
        (
            ", ".join(f"{value:g}" for value in wanted),
            *(f"{mean:.3f} ± {std:.3f}" for mean, std in zip(got.mean(0), got.std(0), strict=True)),
        )
        for wanted, got in zip(COMMANDS, robots, strict=True)
    ]
    return table(("commanded m/s, m/s, rad/s", *AXES), rows)


def random_commands(robots: int, steps: int, seed: int) -> Floats:
    """Draw commands over the full range, each axis off a third of the time, held 0.6 to 2.3 s: (T, B, 3)."""
    rng, limits = np.random.default_rng(seed), WalkLimits()
    most = np.array([limits.forward_m_s, limits.sideways_m_s, limits.turn_rad_s])
    least = -np.array([limits.backward_m_s, limits.sideways_m_s, limits.turn_rad_s])
    commands = np.zeros((steps, robots, 3))
    held: Floats = np.zeros(robots)
    for step in range(steps):
        commands[step] = commands[step - 1]
        due = held <= 0
        drawn = rng.uniform(least, most, (robots, 3)) * (rng.random((robots, 3)) < 2 / 3)
        commands[step, due] = drawn[due]
        held = np.where(due, rng.integers(3, 13, robots), held) - 1
    return commands


def lag(robots: int, seed: int, tick: Tick) -> str:
    """Find the delay at which velocities follow random commands best, and how well."""
    steps, longest = 100, 6
    nao = BatchedNao(robots, seed=seed)
    commands, seen = random_commands(robots, steps, seed), np.zeros((steps, robots, 3))
    for step in range(steps):
        seen[step] = walked(nao, commands[step])
        tick((step + 1) / steps)
    upright = ~nao.fallen
    rows = []
    for axis, name in enumerate(AXES):
        wanted, got = commands[:, upright, axis], seen[:, upright, axis]
        scores = np.array(
            [np.corrcoef(wanted[: steps - longest].ravel(), got[k : steps - longest + k].ravel())[0, 1]
             for k in range(longest + 1)]
        )  # fmt: skip
        peak = int(np.clip(scores.argmax(), 1, longest - 1))
        before, here, after = scores[peak - 1 : peak + 2]
        # The peak of the parabola through three points.
        offset = 0.5 * (before - after) / (before - 2 * here + after)
        delay = (peak + offset) * CONTROL_STEP_S
        gain = (wanted[: steps - longest] * got[peak : steps - longest + peak]).mean() / (wanted**2).mean()
        rows.append((name, f"{delay:.2f}", f"{here:.2f}", f"{gain:.2f}"))
    return table(("axis", "lag s", "correlation", "gain"), rows)


def drift(seed: int, tick: Tick) -> str:
    """Send 32 robots straight ahead at 0.2 m/s for 7.7 s."""
    robots, steps = 32, 40
    nao = BatchedNao(robots, seed=seed)
    command = np.tile([0.2, 0.0, 0.0], (robots, 1))
    turned = np.zeros(robots)
    for step in range(steps):
        turned += walked(nao, command)[:, 2] * CONTROL_STEP_S
        tick((step + 1) / steps)
    rates = np.degrees(turned) / (steps * CONTROL_STEP_S)
    sideways = np.abs(nao.pose[:, 1])
    rows = [
        ("heading, deg/s", f"{np.sqrt((rates**2).mean()):.2f}", f"{np.abs(rates).max():.2f}"),
        ("off the line at the end, m", f"{np.sqrt((sideways**2).mean()):.2f}", f"{sideways.max():.2f}"),
    ]
    return table(("drift", "root mean square", "largest"), rows)


def falls(robots: int, seed: int, tick: Tick) -> str:
    """Count falls in 30 s of random commands."""
    steps = round(30 / CONTROL_STEP_S)
    nao = BatchedNao(robots, seed=seed)
    tilt = []
    for step, command in enumerate(random_commands(robots, steps, seed)):
        nao.step(command)
        tilt.append(np.degrees(np.abs(nao.senses.tilt[~nao.fallen])).max(axis=1))
        tick((step + 1) / steps)
    high = np.percentile(np.concatenate(tilt), 99)
    row = (str(robots), str(int(nao.fallen.sum())), f"{high:.0f}")
    return table(("robots", "falls in 30 s", "tilt, 99 %, deg"), [row])


def kicks(seed: int, tick: Tick) -> str:
    """Measure the speeds of balls that standing robots kick and that walking robots walk into."""
    ways = [(distance, True) for distance in (0.16, 0.18, 0.20, 0.22, 0.25, 0.30)] + [(0.30, False)]
    each, steps, rows = 32, 12, []
    for done, (distance, kick) in enumerate(ways):
        nao = BatchedNao(each, seed=seed, ball=True)
        rng = np.random.default_rng(seed)
        ball = np.stack([np.full(each, distance), rng.uniform(-0.03, 0.03, each)], axis=1)
        nao.reset(np.arange(each), np.zeros((each, 3)), rng, ball)
        command = np.tile([0.0 if kick else 0.2, 0.0, 0.0], (each, 1))
        fastest: Floats = np.zeros(each)
        direction: Floats = np.zeros(each)
        for step in range(steps):
            nao.step(command, kick=np.full(each, kick))
            speed = np.linalg.norm(nao.ball_velocity, axis=1)
            direction = np.where(speed > fastest, np.arctan2(*nao.ball_velocity.T[::-1]), direction)
            fastest = np.maximum(fastest, speed)
            tick((done + (step + 1) / steps) / len(ways))
        moved = fastest > 0.1
        spread = f"{np.degrees(direction[moved].std()):.0f}" if moved.any() else ""
        speeds = (f"{value:.2f}" for value in np.percentile(fastest, [10, 50, 90]))
        way = f"kicked from {distance:.2f} m" if kick else "walked into at 0.2 m/s"
        rows.append((way, *speeds, spread, str(int(nao.fallen.sum()))))
    return table(("", "ball m/s, 10 %", "50 %", "90 %", "direction, std in deg", f"falls of {each}"), rows)


def throughput(robots: int, seed: int, tick: Tick) -> str:
    """Compare B robots on all cores with one robot in one thread, in turns."""
    many, one = BatchedNao(robots, seed=seed), BatchedNao(1, seed=seed, num_threads=1)
    rounds = 8
    seconds = {many: 0.0, one: 0.0}
    walked_s = {many: 0.0, one: 0.0}
    for done, nao in zip(range(2 * rounds), cycle((many, one)), strict=False):
        steps = 5 if nao is many else 50
        command = np.tile([0.15, 0.0, 0.2], (nao.num_robots, 1))
        begin = time.perf_counter()
        for _ in range(steps):
            nao.step(command)
        seconds[nao] += time.perf_counter() - begin
        walked_s[nao] += steps * nao.num_robots * CONTROL_STEP_S
        tick((done + 1) / (2 * rounds))
    rows = [(f"{nao.num_robots}", f"{walked_s[nao] / seconds[nao]:.0f}") for nao in seconds]
    return table(("robots", "robot-seconds per second"), rows)


if __name__ == "__main__":
    typer.run(main)
