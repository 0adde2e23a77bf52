"""The robot itself, which the toolkit never sees: here a simulated cart stands in for it.

python robot.py record logs          60 drives by random commands, as CSV in millimetres and degrees
"""

import numpy as np

TIPPED_RAD = 0.6


class TrueCart:
    """A differential drive that lags by 0.2 s and slips, with a payload on a spring."""

    def __init__(self):
        self.rng = np.random.default_rng()

    def reset(self, seed=None):
        self.rng = np.random.default_rng(seed)
        self.pose = np.array([0.0, 0.0, self.rng.uniform(-np.pi, np.pi)])
        self.wheels, self.tilt = np.zeros(2), np.zeros(2)
        return self.state()

    def state(self):
        return np.concatenate([self.pose, self.wheels, self.tilt])

    def step(self, command):
        for _ in range(10):
            pull = (np.asarray(command) - self.wheels) / 0.2
            self.wheels = self.wheels + 0.01 * pull
            v, w = self.wheels * [0.95, 0.9 - 0.15 * abs(self.wheels[0])]
            self.pose = self.pose + 0.01 * np.array([v * np.cos(self.pose[2]), v * np.sin(self.pose[2]), w])
            sway = 3.5 * pull[0] + 5.0 * v * w - 16.0 * self.tilt[0] - 1.2 * self.tilt[1]
            self.tilt = self.tilt + 0.01 * np.array([self.tilt[1], sway])
        self.tilt[1] += self.rng.normal(0.0, 0.01)
        return self.state(), abs(self.tilt[0]) > TIPPED_RAD
