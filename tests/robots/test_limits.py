"""Limits of the command stream under hostile commands, without a robot: no setpoint exceeds one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rlservo.robots.arm_interface import RobotError, host_of
from rlservo.robots.limits import COUNTED, Limits, MotionLimiter
from rlservo.robots.ur.simulation import URSimulation

Vector = NDArray[np.float64]
DT, SCALE = 0.004, 0.3
START = np.array([0.0, -2.0, 1.5, -1.5, -1.4, 0.0])
WALLS = Limits(
    tool_speed=0.3,
    box_low=(-0.4, -0.4, 0.3),
    box_high=(0.4, 0.4, 0.9),
    position_low=(-1.0, -3.0, -2.0, -3.0, -3.0, -1.0),
    position_high=(1.0, -0.5, 2.0, 1.0, 1.0, 1.0),
)


def extremes(rng: np.random.Generator, step: int) -> Vector:
    return np.full(6, 6.0 if step % 2 else -6.0)


def random(rng: np.random.Generator, step: int) -> Vector:
    return rng.uniform(-6.0, 6.0, 6)


def jittery(rng: np.random.Generator, step: int) -> Vector:
    return START + rng.normal(0.0, 0.3, 6)


@pytest.mark.parametrize("commands", [extremes, random, jittery])
@pytest.mark.parametrize("every", [5, 400])
def test_no_limit_is_passed_and_nothing_jumps(
    commands: Callable[[np.random.Generator, int], Vector], every: int
) -> None:
    simulation, rng = URSimulation("ur5e", objects=()), np.random.default_rng(1)
    most = SCALE * np.array(simulation.parameters.velocity_limits)
    limiter = MotionLimiter(WALLS, simulation, most, 3 * DT)
    limiter.restart(START.tolist())
    goal, before, tool_before = START, np.zeros(6), simulation.tool_at(START)[0]
    counted = np.zeros(len(COUNTED), dtype=np.bool_)
    travelled = 0.0
    for step in range(3000):
        if step % every == 0:
            goal = limiter.goal_within(commands(rng, step // every))
        limiter.step(limiter.velocity_towards(goal, 0.5 - (step % every) * DT, DT), DT, 1.0)
        tool, _ = simulation.tool_at(limiter.position)
        assert (np.abs(limiter.velocity) <= most * 1.0001).all()
        assert (np.abs(limiter.velocity - before) <= WALLS.acceleration * DT * 1.001).all()
        assert (limiter.position >= np.array(WALLS.position_low)).all()
        assert (limiter.position <= np.array(WALLS.position_high)).all()
        assert np.linalg.norm(tool - tool_before) / DT <= WALLS.tool_speed * 1.01
        assert (tool >= np.array(WALLS.box_low)).all() and (tool <= np.array(WALLS.box_high)).all()
        travelled += float(np.abs(limiter.velocity).sum()) * DT
        before, tool_before = limiter.velocity.copy(), tool
        counted |= limiter.limited
    assert travelled > 0.1, "an arm near a limit freezes"
    assert counted[[COUNTED.index("position.base"), COUNTED.index("tool_speed")]].any()


def test_arm_slows_down_along_a_wall_and_reaches_the_goal_beyond_as_far_as_it_may() -> None:
    simulation = URSimulation("ur5e", objects=())
    limits = Limits(position_high=(0.5, *Limits().position_high[1:]))
    limiter = MotionLimiter(limits, simulation, np.full(6, 1.0), DT)
    limiter.restart(START.tolist())
    goal = limiter.goal_within(START + np.array([1.0, 0.2, 0.0, 0.0, 0.0, 0.0]))
    assert limiter.limited[COUNTED.index("position.base")]
    for _ in range(2000):
        limiter.step(limiter.velocity_towards(goal, 0.0, DT), DT, 1.0)
    assert limiter.position[:2] == pytest.approx([0.5, START[1] + 0.2], abs=1e-3)
    assert np.abs(limiter.velocity).max() < 1e-3


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"speed_scale": 2.0}, "speed_scale is 2.0: expected a number from 0.001 to 1"),
        ({"accelleration": 1.0}, "accelleration does not exist"),
        ({"box_low": [0.0, 0.0]}, "box_low is .*: expected 3 numbers"),
        ({"tool_speed": "fast"}, "tool_speed is 'fast'"),
        ({"acceleration": float("nan")}, "acceleration is nan"),
        ({"speed_scale": True}, "speed_scale is True"),
        ({"box_low": 0.0}, r"box_low is 0.0: expected 3 numbers \[m\] from -5 to 5"),
        ({"box_low": [0.0, "a", 0.0]}, "box_low is .*'a'.*: expected 3 numbers"),
        ({"box_low": [-2000.0, -2000.0, 0.0]}, "box_low is .*-2000.0.*: expected 3 numbers"),
        ({"box_high": [2.0, 2.0, float("nan")]}, "box_high is .*nan.*: expected 3 numbers"),
        ({"box_high": [2.0, 2.0, 0.05]}, r"box_high: z is from 0 to 0.05 m, 0.05 m wide: expected more than 0.06"),
        ({"position_high": [90.0] * 6}, r"position_high is .*90.0.*: expected 6 numbers \[rad\] from -6.28 to 6.28"),
        (
            {"position_low": [1.0] * 6, "position_high": [0.5] * 6},
            "position_low and position_high: base is from 1 to 0.5",
        ),
        ({"rate_hz": 8.0}, "rate_hz is 8, but the watchdog waits for 10 commands a second"),
        ([("speed_scale", 0.1)], "limits is a list: expected names with values"),
    ],
)
def test_wrong_limit_is_named(values: Any, words: str) -> None:
    with pytest.raises(RobotError, match=words):
        Limits.of(values)


@pytest.mark.parametrize("robot", ["rtde://", "192.168.0.2", "rtde://a/b", "rtde://a:30004", "ros://a"])
def test_wrong_robot_is_named(robot: str) -> None:
    with pytest.raises(RobotError, match="expected 'mujoco', 'rtde://HOST' or 'ros2:'"):
        host_of(robot)
