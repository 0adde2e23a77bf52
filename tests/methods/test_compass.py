"""The rows whose simulators vary."""

import pytest

from astra_data.robots.registry import TASKS


def test_the_ranges_are_those_printed_in_the_paper() -> None:
    printed = {
        "friction": (0.8, 1.2),
        "action_scale": (-0.1, 0.1),
        "action_noise": (0.05, 0.05),
        "position_noise_m": (0.03, 0.03),
        "velocity_noise_m_s": (0.0, 0.02),
        "heading_bias_deg": (-5.0, 5.0),
        "timestep_scale": (0.015 / 0.02, 0.025 / 0.02),
    }
    for name, ends in printed.items():
        assert getattr(TASKS["antmaze-umaze"].varied.wide, name) == pytest.approx(ends)
