"""Logs of toy joints in the form of PACE's: they follow targets late, with inertia, friction and a sag."""

import numpy as np
from numpy.typing import NDArray

FPS = 400
NAMES = ("LF_HAA", "LF_HFE", "LF_KFE")
STIFFNESS, DAMPING, FRICTION = 900.0, 40.0, 40.0
"""Per unit of inertia, in 1/s², 1/s and rad/s²."""
LATE_ROWS, SAG, NOISE = 6, 0.03, 3e-4
"""Delay; the pull of gravity and the noise of encoders, in rad."""


def targets(rows: int, seed: int) -> NDArray[np.float64]:
    """Return sums of five sines of up to 4 Hz for each joint, (rows, 3)."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.1, 4.0, (5, 3)), rng.uniform(0, 6, (5, 3))
    time = np.arange(rows)[:, None, None] / FPS
    sines = np.sin(2 * np.pi * frequency * time + phase).mean(1)
    return np.asarray(sines * [0.5, 1.0, 2.0] + [0.0, 0.4, 0.8])


def positions(target: NDArray[np.float64], late_rows: int = LATE_ROWS) -> NDArray[np.float64]:
    """Return where the joints are measured before each row and after the last, (rows + 1, 3)."""
    place, speed = target[0].copy(), np.zeros(3)
    places = [place]
    for row in range(len(target)):
        pull = STIFFNESS * (target[max(row - late_rows, 0)] - SAG - place) - DAMPING * speed
        speed = speed + (pull - FRICTION * np.tanh(speed / 0.05)) / FPS
        place = place + speed / FPS
        places.append(place)
    seen = np.array(places)
    return seen + np.random.default_rng(abs(int(1e6 * seen[-1, 0]))).normal(0, NOISE, seen.shape)
