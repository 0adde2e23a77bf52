from typing import Any

import numpy as np
import pytest
import torch
from nao_values import NO_ERRORS

from astra_data.core.arrays import Floats
from astra_data.robots.nao.tasks import NaoEnv
from astra_data.robots.registry import TASKS


def env(task: str = "nao-navigation", count: int = 3, **options: Any) -> NaoEnv:
    made = TASKS[task].target(count, seed=0, num_threads=1, **options)
    assert isinstance(made, NaoEnv)
    made.reset()
    return made


def test_robots_turn_to_their_ball_before_they_walk() -> None:
    one = env("nao-kick", 4, errors=NO_ERRORS)
    place, angle = np.zeros((4, 3)), np.array([0.0, np.pi / 4, np.pi / 2, -3.0])
    one.robots.reset(np.arange(4), place, np.random.default_rng(0))
    one.localisation.reset(np.arange(4), place, np.random.default_rng(0))
    one.sight.reset(np.arange(4), np.stack([np.cos(angle), np.sin(angle)], axis=1))
    ahead = torch.tensor([[1.0, 0.0]]).expand(4, 2)
    command = one._body_command(ahead, np.zeros(4, dtype=bool))
    np.testing.assert_allclose(command[:, 0] / command[0, 0], [1.0, 0.5, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.sign(command[:, 2]), [0.0, 1.0, 1.0, -1.0])
    kicking = one._body_command(0 * ahead, np.ones(4, dtype=bool))
    assert (kicking[:, :2] == 0).all()
    np.testing.assert_array_equal(kicking[:, 2], command[:, 2])


def test_a_kick_reaches_a_foot_far_and_moves_no_robot() -> None:
    one = env("nao-kick", 8, errors=NO_ERRORS)
    place, angle = np.zeros((8, 3)), np.linspace(-np.pi, np.pi, 8)
    place[:, 2] = angle
    distance = np.array([0.17, 0.3] * 4)[:, None]
    ball = distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    one.robots.reset(np.arange(8), place, np.random.default_rng(0), ball)
    one.localisation.reset(np.arange(8), place, np.random.default_rng(0))
    one.sight.reset(np.arange(8), ball)
    fastest: Floats = np.zeros(8)
    for _ in range(10):
        one.step(torch.tensor([[1.0, 0.0, 1.0]]).expand(8, 3))
        fastest = np.maximum(fastest, np.linalg.norm(one.robots.ball_velocity, axis=1))
    assert fastest[::2].min() > 0.35 and fastest[1::2].max() == pytest.approx(0.0, abs=0.02)
    assert np.abs(one.robots.pose[:, :2]).max() < 0.1 and not one.robots.bodies.fallen.any()


def test_robots_can_be_stood_where_a_state_believes_them() -> None:
    one = env("nao-kick", 2)
    state = one.state.double().numpy()
    one.step(torch.ones(2, 3))
    one.reset_to(np.arange(2), state)
    np.testing.assert_allclose(one.robots.pose[:, :2], state[:, :2], atol=1e-6)
    np.testing.assert_allclose(np.cos(one.robots.pose[:, 2]), state[:, 2], atol=1e-6)
    np.testing.assert_allclose(one.robots.ball, state[:, 29:31], atol=1e-6)


def test_robots_turn_the_short_way_and_at_most_by_1_rad_a_second() -> None:
    one = env(count=5, errors=NO_ERRORS)
    heading = np.array([0.0, 0.0, 3.0, -3.0, 2.0])
    one.localisation.pose[:, 2] = heading
    angle = torch.tensor([0.25, np.pi / 2, -3.0, 3.0, 2.0])
    command = one._body_command(torch.stack([angle.cos(), angle.sin()], dim=1), None)
    short = 2 * np.pi - 6.0
    np.testing.assert_allclose(command[:, 2], [0.5, 1.0, 2 * short, -2 * short, 0.0], atol=1e-6)
    # A full command is 0.25 m/s, told along the heading and to its left.
    ahead = 0.25 * np.exp(1j * (angle.double().numpy() - heading))
    np.testing.assert_allclose(command[:, :2], np.column_stack([ahead.real, ahead.imag]), atol=1e-6)


def test_commands_are_clipped_and_next_to_none_turns_nobody() -> None:
    one = env(count=3, errors=NO_ERRORS)
    one.localisation.pose[:, 2] = 1.0
    commands = torch.tensor([[7.0, -3.0], [1.0, -1.0], [0.04, 0.0]])
    wild, tame, standing = one._body_command(commands, None)
    np.testing.assert_array_equal(wild, tame)
    assert tame[2] < 0 and standing[2] == 0


def test_states_tell_the_planned_velocity_in_the_world() -> None:
    one = env(count=3, errors=NO_ERRORS)
    heading = np.array([0.3, 2.0, -2.5])
    one.localisation.pose[:, 2] = heading
    gait = one.robots.gait
    gait.before[:], gait.after[:], gait.duration_s[:] = [0.02, 0.01, 0.1], [0.04, -0.05, 0.1], 0.25
    planned = (0.12 - 0.08j) * np.exp(1j * heading)  # half of 6 cm forward and of 4 cm to the right in 0.25 s
    np.testing.assert_allclose(one.state[:, 4:6], np.column_stack([planned.real, planned.imag]), atol=1e-6)
    np.testing.assert_allclose(one.state[:, 26:29], np.tile([0.12, -0.08, 0.4], (3, 1)), atol=1e-6)
