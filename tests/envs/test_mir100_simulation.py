"""The simulated MiR100 against hand-computed motions and distances."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rlservo.robots.mir100.model import TIMESTEP
from rlservo.robots.mir100.parameters import BACK_SCANNER, BODY_CENTRE, FRONT_SCANNER, LENGTH, MASS
from rlservo.robots.mir100.simulation import Mir100Simulation

# The lab's inner faces, from the world file: walls 0.15 m thick round 6 x 8 m, all of it moved by (-0.027, 0.014).
EAST, WEST, NORTH, SOUTH = 2.85 - 0.027, -2.85 - 0.027, 3.85 + 0.014, -3.85 + 0.014
FRONT, BACK = slice(FRONT_SCANNER.count), slice(FRONT_SCANNER.count, None)  # of a scan
MIDDLE = (-0.027, 0.014, 0.0)
CYCLE = 0.1
AWAY = [(50.0, 0.0, 0.0), (52.0, 0.0, 0.0), (54.0, 0.0, 0.0)]  # cubes out of the room


def lab(*, laser_noise: float = 0.0, seed: int = 0) -> Mir100Simulation:
    sim = Mir100Simulation("lab_6x8", laser_noise=laser_noise, rng=np.random.default_rng(seed))
    sim.place(MIDDLE, cubes=AWAY)
    return sim


def drive(sim: Mir100Simulation, linear: float, angular: float, cycles: int) -> None:
    for _ in range(cycles):
        sim.command(linear, angular)
        sim.advance()


def slip(sim: Mir100Simulation) -> float:
    """Velocity across the heading [m/s]: the physics step's mean velocity, so the heading in the middle of the step."""
    vx, vy, angular = sim.data.qvel
    yaw = sim.data.qpos[2] - angular * TIMESTEP / 2
    return float(vy * math.cos(yaw) - vx * math.sin(yaw))


# -- lasers


def test_beams_straight_at_the_walls_read_the_hand_computed_distances() -> None:
    sim = lab()
    front, back = sim.scan[FRONT], sim.scan[BACK]
    # Front scanner at (0.4288, 0.2358); its beam i points to -75 + i/2 degrees.
    assert front[150] == pytest.approx(2.85 - 0.4288, abs=1e-9)  # 0 degrees, east
    assert front[330] == pytest.approx(3.85 - 0.2358, abs=1e-9)  # 90 degrees, north
    assert front[240] == pytest.approx((2.85 - 0.4288) * math.sqrt(2), abs=1e-9)  # 45 degrees, east too
    # Back scanner at (-0.3548, -0.2352); its beam i points to 95 + i/2 degrees.
    assert back[170] == pytest.approx(2.85 - 0.3548, abs=1e-9)  # 180 degrees, west
    assert back[350] == pytest.approx(3.85 - 0.2352, abs=1e-9)  # 270 degrees, south


def test_beams_run_counter_clockwise_between_the_contracts_angles() -> None:
    front, back = np.degrees(FRONT_SCANNER.angles), np.degrees(BACK_SCANNER.angles)
    assert (len(front), len(back)) == (501, 511)
    # 541 beams over -135 .. 135 degrees; 30 + 10 and 10 + 20 dropped; turned by 45 and -135 degrees.
    assert (front[0], front[-1]) == (pytest.approx(-135 + 15 + 45), pytest.approx(135 - 5 + 45))
    assert (back[0], back[-1]) == (pytest.approx(-135 + 5 - 135), pytest.approx(135 - 10 - 135))
    assert np.diff(front) == pytest.approx(0.5)
    assert np.diff(back) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(5))
def test_every_beam_reads_its_distance_to_the_walls_from_any_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, yaw = rng.uniform((-2.0, -3.0, -math.pi), (2.0, 3.0, math.pi))
    sim = lab()
    sim.place((x, y, yaw), cubes=AWAY)
    expected = []
    for scanner in (FRONT_SCANNER, BACK_SCANNER):
        ahead, left, _ = scanner.position
        origin_x = x + ahead * math.cos(yaw) - left * math.sin(yaw)
        origin_y = y + ahead * math.sin(yaw) + left * math.cos(yaw)
        for angle in scanner.angles + yaw:
            cos, sin = math.cos(angle), math.sin(angle)
            to_x = ((EAST if cos > 0 else WEST) - origin_x) / cos
            to_y = ((NORTH if sin > 0 else SOUTH) - origin_y) / sin
            expected.append(min(to_x, to_y))
    assert sim.scan == pytest.approx(expected, abs=1e-9)


def test_a_cube_to_the_left_shortens_the_beams_to_the_left_only() -> None:
    sim = lab()
    empty = sim.scan.copy()
    x, y, _ = MIDDLE
    sim.place(MIDDLE, cubes=[(x + 0.4288, y + 0.2358 + 1.25, 0.0), *AWAY[1:]])  # its near face 1 m left of the scanner
    front = sim.scan[FRONT]
    assert front[330] == pytest.approx(1.0, abs=1e-9)
    changed = np.flatnonzero(np.abs(sim.scan - empty) > 1e-9)
    half_width = math.degrees(math.atan2(0.25, 1.0))  # the near face is 0.5 m wide
    seen_by_front = changed[changed < 501]
    assert seen_by_front.tolist() == list(range(330 - int(2 * half_width), 330 + int(2 * half_width) + 1))


def test_half_a_turn_in_the_symmetric_room_gives_the_same_scan() -> None:
    sim = lab()
    first = sim.scan.copy()
    x, y, _ = MIDDLE
    sim.place((x, y, math.pi), cubes=AWAY)
    assert sim.scan == pytest.approx(first, abs=1e-9)


def test_the_robot_does_not_see_itself_the_floor_or_the_target() -> None:
    sim = Mir100Simulation("lab_6x8", laser_noise=0.0)
    x, y, _ = MIDDLE
    sim.place(MIDDLE, target=(x + 1.0, y + 0.2358, 0.0), cubes=AWAY)  # right in front of the front scanner
    assert sim.scan[FRONT][150] == pytest.approx(2.85 - 0.4288, abs=1e-9)
    assert sim.scan.min() > 2.0


def test_beams_that_meet_nothing_read_the_maximum_without_noise() -> None:
    empty = Mir100Simulation("empty", laser_noise=0.01)
    assert (empty.scan == 29.0).all()
    outside = lab(laser_noise=0.01)
    outside.place((20.0, 0.0, 0.0), cubes=AWAY)
    readings, counts = np.unique(outside.scan, return_counts=True)
    assert readings[-1] == 29.0
    assert counts[-1] > 900  # of 1012; the others see the room and the cubes from outside
    assert counts[:-1].max() == 1


def test_noise_has_the_scanners_deviation_and_stays_in_range() -> None:
    sim = lab(laser_noise=0.01)
    exact = lab().scan
    errors = []
    for _ in range(50):
        sim.place(MIDDLE)
        errors.append(sim.scan - exact)
    error = np.array(errors)
    assert error.std() == pytest.approx(0.01, rel=0.02)
    assert abs(error.mean()) < 2e-4
    assert abs(np.corrcoef(error[0], error[1])[0, 1]) < 0.15  # new noise each time


def test_scan_stays_the_same_until_time_passes() -> None:
    sim = lab(laser_noise=0.01)
    first = sim.scan.copy()
    assert (sim.scan == first).all()
    sim.advance()
    assert (sim.scan != first).mean() > 0.99


# -- driving


def test_straight_drive_covers_the_integral_of_the_velocity_profile() -> None:
    sim = Mir100Simulation()
    drive(sim, 0.5, 0.0, 30)
    x, y, yaw = sim.pose
    assert x == pytest.approx(0.5 * 3.0 - 0.5**2 / (2 * 2.0), abs=0.005)  # at 2 m/s^2 up to 0.5 m/s, then constant
    assert (y, yaw) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-9))
    assert sim.velocity == (pytest.approx(0.5, abs=1e-6), pytest.approx(0.0, abs=1e-9))


def test_turning_in_place_keeps_the_axle_where_it_is() -> None:
    sim = Mir100Simulation()
    sim.place((1.0, -2.0, 0.3))
    drive(sim, 0.0, 0.7, 40)
    x, y, yaw = sim.pose
    assert math.hypot(x - 1.0, y + 2.0) < 1e-3
    turned = 0.7 * 4.0 - 0.7**2 / (2 * 2.5)  # at 2.5 rad/s^2 up to 0.7 rad/s, then constant
    assert (yaw - 0.3) % (2 * math.pi) == pytest.approx(turned, abs=0.005)


def test_constant_velocities_drive_a_circle_of_their_ratio_without_slipping() -> None:
    sim = Mir100Simulation()
    drive(sim, 1.0, 1.5, 20)
    points = []
    for _ in range(200):  # nearly five rounds
        drive(sim, 1.0, 1.5, 1)
        points.append(sim.pose[:2])
        assert abs(slip(sim)) < 0.002
    xy = np.array(points)
    # Least squares of x^2 + y^2 = 2 x a + 2 y b + c, the circle round (a, b) with radius^2 = c + a^2 + b^2.
    a, b, c = np.linalg.lstsq(np.c_[2 * xy, np.ones(len(xy))], (xy**2).sum(axis=1), rcond=None)[0]
    radius = math.sqrt(c + a * a + b * b)
    assert radius == pytest.approx(1.0 / 1.5, rel=0.003)  # the centre of mass, ahead of the axle, brakes the turn
    assert np.hypot(xy[:, 0] - a, xy[:, 1] - b) == pytest.approx(radius, abs=1e-9)  # always the same circle


def test_acceleration_never_exceeds_its_limits() -> None:
    sim = Mir100Simulation()
    linear, angular = [0.0], [0.0]
    rng = np.random.default_rng(0)
    for _ in range(200):
        sim.command(*rng.choice([-9.0, 9.0], 2))
        sim.advance()
        linear.append(sim.velocity[0])
        angular.append(sim.velocity[1])
    assert 0.99 < np.abs(np.diff(linear)).max() / (2.0 * CYCLE) < 1.01
    assert 0.99 < np.abs(np.diff(angular)).max() / (2.5 * CYCLE) < 1.01


def test_velocity_rises_along_the_acceleration_limit_to_the_velocity_limit() -> None:
    sim = Mir100Simulation()
    seen = []
    for _ in range(8):
        drive(sim, 5.0, 9.0, 1)
        seen.append(sim.velocity)
    assert [v for v, _ in seen] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0, 1.0], abs=0.02)
    assert [w for _, w in seen] == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.5, 1.5], abs=0.02)
    assert sim.velocity == (pytest.approx(1.0, abs=0.005), pytest.approx(1.5, abs=0.005))


def test_a_command_holds_for_half_a_second_and_then_the_robot_stops() -> None:
    sim = Mir100Simulation()
    drive(sim, 0.5, 0.0, 5)
    for _ in range(4):  # the last command is one cycle old by now
        sim.advance()
        assert sim.velocity[0] == pytest.approx(0.5, abs=0.001)
    sim.advance()
    assert sim.velocity[0] == pytest.approx(0.3, abs=0.011)  # slowing down at 2 m/s^2
    sim.advance()
    sim.advance()
    assert sim.velocity[0] == pytest.approx(0.0, abs=0.001)


def test_a_repeated_command_renews_the_time_out() -> None:
    sim = Mir100Simulation()
    drive(sim, 0.5, 0.0, 40)
    assert sim.velocity[0] == pytest.approx(0.5, abs=1e-6)


def test_mass_and_inertia_are_those_of_the_data() -> None:
    model = Mir100Simulation().model
    assert model.body_subtreemass[0] == pytest.approx(MASS)
    # A homogeneous box, about its own centre.
    assert model.body("base_link").inertia[2] == pytest.approx(58.0 * (0.9**2 + 0.58**2) / 12)
    assert model.body("base_link").ipos == pytest.approx(BODY_CENTRE)


# -- contacts


def test_driving_into_a_wall_is_a_collision_and_the_wall_holds() -> None:
    sim = lab()
    drive(sim, 0.5, 0.0, 40)
    assert not sim.in_collision
    drive(sim, 0.5, 0.0, 20)
    assert sim.in_collision
    assert sim.contacts() == ["wall_east"]
    nose = sim.pose[0] + BODY_CENTRE[0] + LENGTH / 2
    assert nose == pytest.approx(EAST, abs=0.03)
    assert sim.velocity[0] == pytest.approx(0.0, abs=0.01)


def test_driving_into_a_cube_is_a_collision() -> None:
    sim = lab()
    x, y, _ = MIDDLE
    sim.place(MIDDLE, cubes=[(x + 1.2, y, 0.5), *AWAY[1:]])
    assert not sim.in_collision
    drive(sim, 0.5, 0.0, 20)
    assert sim.in_collision
    assert sim.contacts() == ["cube_0"]


def test_a_contact_early_in_a_cycle_is_still_reported_at_its_end_and_forgotten_a_cycle_later() -> None:
    sim = lab()
    against_the_wall = EAST - BODY_CENTRE[0] - LENGTH / 2 + 0.001  # one millimetre into it
    assert sim.place((against_the_wall, 0.0, 0.0))
    drive(sim, -1.0, 0.0, 1)
    assert sim.contacts() == []  # it has moved off by now
    assert sim.in_collision
    drive(sim, -1.0, 0.0, 1)
    assert not sim.in_collision


def test_a_move_is_refused_while_something_is_within_4_cm_of_a_scanner() -> None:
    sim = lab()
    x, y, _ = MIDDLE

    def place_cube(gap: float) -> None:
        """One whose face is `gap` ahead of the front scanner, well inside the housing."""
        sim.place(MIDDLE, cubes=[(x + 0.4288 + gap + 0.25, y + 0.2358, 0.0), *AWAY[1:]])

    place_cube(0.039)
    assert sim.is_blocked
    assert sim.scan[FRONT].min() == 0.05  # a reading is clipped to the scanner's range
    assert not sim.command(0.5, 0.0)
    sim.advance()
    assert sim.pose[0] <= x + 1e-9
    place_cube(0.045)
    assert sim.scan[FRONT].min() == 0.05
    assert not sim.is_blocked
    sim.place(MIDDLE, cubes=AWAY)
    assert sim.command(0.5, 0.0)
    sim.advance()
    assert sim.pose[0] > x + 0.005


# -- state and misuse


def test_state_is_laid_out_as_the_robot_servers() -> None:
    sim = lab()
    cubes = [(1.0, 2.0, 0.1), (1.5, -2.0, 0.2), (-1.5, 2.0, 0.3)]
    sim.place((0.5, -0.5, 4.0), target=(1.0, 1.5, 0.25), cubes=cubes)
    drive(sim, 0.4, 0.3, 5)
    state = sim.state()
    assert state.shape == (1030,)
    assert state[0:3].tolist() == [1.0, 1.5, 0.25]
    assert state[3:6].tolist() == list(sim.pose)
    assert -math.pi <= state[5] < math.pi
    assert state[6:8] == pytest.approx([0.4, 0.3], abs=0.02)
    assert (state[8:509] == sim.scan[FRONT]).all()
    assert (state[509:1020] == sim.scan[BACK]).all()
    assert state[1020] == 0.0
    assert state[1021:1030].reshape(3, 3).tolist() == [list(cube) for cube in cubes]
    drive(sim, 0.5, 0.0, 80)
    assert sim.state()[1020] == 1.0


def test_place_forgets_motion_command_and_collision() -> None:
    sim = lab()
    drive(sim, 1.0, 0.5, 60)
    assert sim.in_collision
    assert not sim.place(MIDDLE)
    sim.advance()
    assert sim.pose == pytest.approx(MIDDLE, abs=1e-12)
    assert sim.velocity == pytest.approx((0.0, 0.0), abs=1e-12)


def test_misuse_is_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="world 'lab' does not exist: expected one of empty, lab_6x8"):
        Mir100Simulation("lab")
    with pytest.raises(ValueError, match=r"laser_noise is -1: expected a standard deviation"):
        Mir100Simulation(laser_noise=-1.0)
    sim = lab()
    with pytest.raises(ValueError, match=r"\(nan m/s, 0 rad/s\): expected finite numbers"):
        sim.command(math.nan, 0.0)
    with pytest.raises(ValueError, match=r"the pose of the robot is \[0.0, 1.0\]: expected three finite numbers"):
        sim.place((0.0, 1.0))
    with pytest.raises(ValueError, match=r"the pose of the cube 1 is \[inf, 0.0, 0.0\]"):
        sim.place(MIDDLE, cubes=[AWAY[0], (math.inf, 0.0, 0.0), AWAY[2]])
    with pytest.raises(ValueError, match="2 cubes were given; world 'lab_6x8' has 3"):
        sim.place(MIDDLE, cubes=AWAY[:2])
