"""The robot itself: a simulated cart stands in for it.

python robot.py logs [drives]       records drives by random commands as CSV, in millimeters and degrees
python robot.py play RUN [trials]   sends the cart to its dock by the policies of a run, and counts
"""

import csv
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from cart import DOCK_M, TASK

from astra_data import load_policy
from astra_data.core.lazy import torch  # loads with its first use: `check` answers without it

TIPPED_RAD = 0.6


class TrueCart:
    """A differential drive that lags by 0.2 s and slips, with a payload on a spring that fast curves tip."""

    def __init__(self):
        self.rng = np.random.default_rng()

    def reset(self, seed=None):
        self.rng = np.random.default_rng(seed)
        self.x, self.y, self.yaw = 0.0, 0.0, self.rng.uniform(-np.pi, np.pi)
        self.wheels, self.tilt = np.zeros(2), np.zeros(2)
        return self.state()

    def state(self):
        return [self.x, self.y, np.cos(self.yaw), np.sin(self.yaw), *self.wheels, *self.tilt]

    def step(self, command):
        for _ in range(10):
            pull = (np.asarray(command) - self.wheels) / 0.2
            self.wheels = self.wheels + 0.01 * pull
            v, w = self.wheels * [0.95, 0.9 - 0.15 * abs(self.wheels[0])]
            self.x += 0.01 * v * np.cos(self.yaw)
            self.y += 0.01 * v * np.sin(self.yaw)
            self.yaw += 0.01 * w
            sway = 3.0 * pull[0] + 40.0 * v * w - 36.0 * self.tilt[0] - 8.0 * self.tilt[1]
            self.tilt = self.tilt + 0.01 * np.array([self.tilt[1], sway])
        self.tilt[1] += self.rng.normal(0.0, 0.01)
        return self.state(), bool(abs(self.tilt[0]) > TIPPED_RAD)


TASK = replace(TASK, robot=TrueCart)  # the same task, with a target to collect and to test in

FIELDS = ["x_mm", "y_mm", "heading_x", "heading_y", "v_mm_s", "w_deg_s", "tilt_deg", "tilt_rate_deg_s"]
UNITS = [1e-3, 1e-3, 1.0, 1.0, 1e-3, np.pi / 180, np.pi / 180, np.pi / 180]


def record(folder, drives=60, seconds=15, seed=0):
    """Drive by random commands, each held for 0.1 to 2 s, until the payload tips."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for drive in range(drives):
        cart = TrueCart()
        state, tipped, left = cart.reset(int(rng.integers(2**32))), False, 0
        with open(folder / f"drive_{drive:02d}.csv", "w", newline="") as file:
            log = csv.writer(file)
            log.writerow(["t_ms", *FIELDS, "cmd_v_mm_s", "cmd_w_deg_s", "tipped"])
            for step in range(10 * seconds):
                if left == 0:
                    command, left = rng.uniform([-0.2, -1.5], [1.0, 1.5]), rng.integers(1, 21)
                left -= 1
                row = [*np.divide(state, UNITS), command[0] / 1e-3, np.degrees(command[1])]
                log.writerow([100 * step, *(f"{value:.4f}" for value in row), int(tipped)])
                if tipped:
                    break
                state, tipped = cart.step(command)


def play(run, trials=100, seed=0):
    """Print which share of its trials each policy of a run delivers, and tips."""
    for trained in sorted((Path(run) / "train").glob("*/seed_*")) or sys.exit(f"{run}: expected trained policies"):
        row, its_seed = trained.parent.name, int(trained.name.removeprefix("seed_"))
        policy, rng = load_policy(run, row, seed=its_seed), np.random.default_rng(seed)
        carts = [TrueCart() for _ in range(trials)]
        states = np.array([cart.reset(int(rng.integers(2**32))) for cart in carts])
        delivered, tipped = np.zeros(trials, bool), np.zeros(trials, bool)
        policy.start(trials)
        for _ in range(policy.task.objective.horizon):
            seen = torch.tensor(states, dtype=torch.float32)
            commands = policy.command(seen, torch.empty(trials, 0)).numpy()
            for number in np.flatnonzero(~delivered & ~tipped):
                states[number], tipped[number] = carts[number].step(commands[number])
            delivered |= (np.linalg.norm(states[:, :2] - DOCK_M, axis=1) < 0.3) & ~tipped
        print(f"{row}, seed {its_seed}: delivered {delivered.mean():.2f}, tipped {tipped.mean():.2f}")


if __name__ == "__main__":
    command, *rest = sys.argv[1:] or sys.exit(__doc__)
    if command == "play":
        play(rest[0], *map(int, rest[1:]))
    else:
        record(Path(command), *map(int, rest))
