"""The objects of the UR scene: their paths against scipy's and robo-gym's figures, and what touching one does."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from rlservo.robots.ur.object_paths import interpolate, object_path
from rlservo.robots.ur.simulation import URSimulation

START = np.array([0.0, -2.5, 1.5, -1.5, -1.4, 0.0])
BOX = {"x_min": -1.0, "x_max": 1.0, "y_min": -1.0, "y_max": 1.0, "z_min": 0.1, "z_max": 1.0}


def path_of(function: str, seed: int = 0, /, **parameters: float) -> np.ndarray:
    values = {f"object_0_{name}": value for name, value in parameters.items()}
    return object_path(function, 0, values, np.random.default_rng(seed))


# -- paths


def test_fixed_position_is_one_position() -> None:
    assert path_of("fixed_position", x=0.1, y=-0.2, z=0.3).tolist() == [[0.1, -0.2, 0.3]]


@pytest.mark.parametrize("frequency", [0.125, 0.3, 1.0, 7.0])
def test_triangle_wave_is_scipys_sawtooth_at_100_hz(frequency: float) -> None:
    from scipy import signal  # here: it takes a second

    path = path_of("triangle_wave", x=0.12, y=0.34, z_amplitude=0.2, z_frequency=frequency, z_offset=0.5)
    count = int(100 / frequency)
    t = np.linspace(0, 1 / frequency, count)
    assert path.shape == (count, 3)
    assert (path[:, 0] == 0.12).all()
    assert (path[:, 1] == 0.34).all()
    # At the very end of the period scipy's phase wraps or not, by rounding: both are the lowest point.
    expected = 0.5 + 0.2 * signal.sawtooth(2 * np.pi * frequency * t, 0.5)
    assert path[:, 2] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("count", [4, 5, 10, 30])
def test_spline_is_scipys_splprep(count: int) -> None:
    from scipy import interpolate as scipy_interpolate

    points = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    points[-1] = points[0]
    knots, _ = scipy_interpolate.splprep(points.T.tolist(), s=0)
    expected = np.transpose(scipy_interpolate.splev(np.linspace(0, 1, 777), knots))
    assert interpolate(points, 777) == pytest.approx(expected, abs=1e-9)


def test_spline_is_closed_and_as_long_as_asked() -> None:
    path = path_of("3d_spline", 3, **BOX, n_points=8, n_sampling_points=500)
    assert path.shape == (500, 3)
    assert path[0] == pytest.approx(path[-1])
    assert np.ptp(path, axis=0).min() > 0.2  # it goes somewhere
    same = path_of("3d_spline", 3, **BOX, n_points=8, n_sampling_points=500)
    other = path_of("3d_spline", 4, **BOX, n_points=8, n_sampling_points=500)
    assert (path == same).all()
    assert not np.allclose(path, other)


@pytest.mark.parametrize("seed", range(5))
def test_workspace_spline_keeps_away_from_the_arms_base(seed: int) -> None:
    path = path_of("3d_spline_ur5_workspace", seed, **BOX, n_points=10, n_sampling_points=4000)
    horizontal = np.hypot(path[:, 0], path[:, 1])
    assert horizontal.min() > 0.2
    assert np.hypot(horizontal, path[:, 2]).min() > 0.35
    assert (np.abs(path[0, :2]) >= 0.5).all()


def test_older_servers_shared_n_sampling_points_is_understood() -> None:
    values = {f"object_0_{name}": value for name, value in BOX.items()} | {"object_0_n_points": 6.0}
    path = object_path("3d_spline", 0, {**values, "n_sampling_points": 50.0}, np.random.default_rng(0))
    assert len(path) == 50


@pytest.mark.parametrize("function", ["fixed_position_a_b", "fixed_position_ab"])
def test_a_b_holds_each_for_its_time(function: str) -> None:
    path = path_of(function, x_a=0, y_a=0, z_a=1, x_b=1, y_b=2, z_b=3, hold_a=0.5, hold_b=1.25)
    assert path.shape == (175, 3)
    assert (path[:50] == [0, 0, 1]).all()
    assert (path[50:] == [1, 2, 3]).all()


@pytest.mark.parametrize("function", ["interpolated_a_b_c", "interpolated_abc"])
def test_a_b_c_moves_straight_between_its_stops(function: str) -> None:
    corners = {"x_a": 0, "y_a": 0, "z_a": 0, "x_b": 1, "y_b": 0, "z_b": 0, "x_c": 1, "y_c": 1, "z_c": 0}
    path = path_of(
        function, **corners, hold_a=0.1, hold_b=0.2, hold_c=0.3, n_sampling_points_ab=11, n_sampling_points_bc=21
    )
    assert path.shape == (10 + 11 + 20 + 21 + 30, 3)
    assert path[10:21, 0] == pytest.approx(np.linspace(0, 1, 11))
    assert (path[21:41] == [1, 0, 0]).all()
    assert path[41:62, 1] == pytest.approx(np.linspace(0, 1, 21))
    assert (path[62:] == [1, 1, 0]).all()


@pytest.mark.parametrize(
    ("function", "parameters", "message"),
    [
        ("zigzag", {}, r"object_0_function'\] is 'zigzag': expected one of fixed_position, triangle_wave, 3d_spline"),
        ("fixed_position", {"x": 1.0, "y": 1.0}, "float_params lacks 'object_0_z'"),
        ("fixed_position", {"x": math.nan, "y": 1.0, "z": 1.0}, r"object_0_x'\] is nan: expected a finite number"),
        (
            "triangle_wave",
            {"x": 0, "y": 0, "z_amplitude": 1, "z_frequency": 0, "z_offset": 0},
            "z_frequency is 0 Hz: expected 0.0001 to 100 Hz",
        ),
        ("3d_spline", {**BOX, "n_points": 3, "n_sampling_points": 9}, r"n_points'\] is 3: expected 4 to 1,000,000"),
        ("3d_spline", {**BOX, "n_points": 9, "n_sampling_points": 1e9}, r"is 1e\+09: expected 2 to 1,000,000"),
        ("3d_spline", {**BOX, "x_min": 2.0, "n_points": 9, "n_sampling_points": 9}, "expected min below max"),
        (
            "3d_spline",
            dict.fromkeys(BOX, 0.5) | {"n_points": 9, "n_sampling_points": 9},
            "neighbouring points of a spline coincide",
        ),
        (
            "fixed_position_a_b",
            {"x_a": 0, "y_a": 0, "z_a": 0, "x_b": 0, "y_b": 0, "z_b": 0, "hold_a": 0, "hold_b": 0},
            "has no duration",
        ),
        (
            "fixed_position_a_b",
            {"x_a": 0, "y_a": 0, "z_a": 0, "x_b": 0, "y_b": 0, "z_b": 0, "hold_a": -1, "hold_b": 0},
            r"hold_a'\] is -1 s: expected 0 to 10,000 s",
        ),
    ],
)
def test_impossible_function_is_refused_by_name(function: str, parameters: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        path_of(function, **parameters)


# -- in the scene


def test_objects_move_at_100_hz_and_start_again() -> None:
    sim = URSimulation("ur5", cycle_s=0.05, objects=("sphere50_no_collision", "sphere50"))
    sim.place(START)
    path = np.stack([np.linspace(1.0, 1.12, 13), np.zeros(13), np.full(13, 0.5)], axis=1)
    sim.move_objects({1: path})
    assert sim.object_position(1) == pytest.approx(path[0])
    for cycle in range(1, 40):
        sim.advance()
        assert sim.object_position(1) == pytest.approx(path[5 * cycle % 13])
    assert sim.object_position(0) == pytest.approx([0.0, 0.0, 3.0])  # the other one was never placed
    sim.place_object(1, [0.5, 0.5, 0.5])
    sim.advance()
    assert sim.object_position(1) == pytest.approx([0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("model", "reach", "collides"),
    [
        ("sphere50", 0.025, True),
        ("sphere50_no_collision", 0.025, False),
        ("green_sphere50_no_collision", 0.025, False),
        ("box50", 0.025, True),
        ("box100", 0.05, True),
    ],
)
def test_touching_a_solid_object_is_a_collision_and_pushes_nothing(model: str, reach: float, collides: bool) -> None:
    arms = [URSimulation("ur5", max_velocity_scale=0.5, objects=objects) for objects in ((model,), ())]
    for sim in arms:
        sim.place(START)
    arms[0].place_object(0, arms[0].tool_position - [0.0, 0.0, reach])
    for _ in range(20):
        for sim in arms:
            sim.command(START + [0.4, 0.3, -0.3, 0.2, 0.2, 1.0])
            sim.advance()
    assert arms[0].in_collision == collides
    assert np.abs(arms[0].joint_positions - arms[1].joint_positions).max() < 1e-6
    assert not arms[0].place(START)  # the object is out of the way again
    arms[0].advance()
    assert not arms[0].in_collision


def test_object_touching_the_table_or_nothing_is_no_collision() -> None:
    sim = URSimulation("ur5", objects=("box100",))
    sim.place(START)
    for where in ([0.3, 0.4, 0.0], [1.0, 1.0, 1.0], [0.3, 0.4, -0.1]):
        sim.place_object(0, where)
        sim.advance()
        assert not sim.in_collision


def test_moving_object_that_reaches_the_resting_arm_collides_at_that_moment() -> None:
    sim = URSimulation("ur5", cycle_s=0.05, objects=("sphere50",))
    sim.place(START)
    tool = sim.tool_position
    sim.move_objects({0: tool + np.linspace([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], 200)})  # half a metre a second
    ball = sim.model.geom("object_0").id
    links = [geom for geom in range(sim.model.ngeom) if sim.model.geom_contype[geom] == 1]
    distance = before = math.inf
    while not sim.in_collision:
        before = distance
        sim.advance()
        distance = min(mujoco.mj_geomDistance(sim.model, sim.data, ball, link, 2.0, None) for link in links)
    assert before > 0.0  # not a cycle too early
    assert -0.03 < distance < 0.005  # nor too late: it comes 2.5 cm nearer in a cycle


def test_without_a_table_the_arm_may_reach_where_the_table_was() -> None:
    joints = [0.0, 0.15, 0.0, -1.57, 0.0, 0.0]  # stretched out, a little below the horizontal
    with_table, without = URSimulation("ur5"), URSimulation("ur5", table=False)
    assert with_table.place(joints)
    assert not without.place(joints)
    assert without.place([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])  # the ground is still there


def test_unknown_object_model_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="object model 'sphere5' does not exist: expected one of sphere50, "):
        URSimulation(objects=("sphere5",))


# -- payload


@pytest.mark.parametrize("payload", [1.0, 5.0])
def test_payload_bends_the_servos_as_statics_says(payload: float) -> None:
    sim = URSimulation("ur5")
    sim.set_payload(payload)
    sim.place(START)
    for _ in range(60):
        sim.command(START)
        sim.advance()
    # Torque of the weight about each joint, by the geometric Jacobian, over the servo's stiffness.
    jacobian = np.zeros((3, 6))
    mujoco.mj_jacSite(sim.model, sim.data, jacobian, None, sim.model.site("tool0").id)
    torque = jacobian.T @ [0.0, 0.0, -9.81 * payload]
    stiffness = sim.model.actuator_gainprm[[sim.model.actuator(n).id for n in ("base", "shoulder", "elbow")], 0]
    sag = sim.joint_positions - START
    assert np.abs(sag[1:3]).max() > 1e-4
    assert sag[1:3] == pytest.approx(torque[1:3] / stiffness[1:3], rel=0.05, abs=2e-5)


def test_payload_taken_off_leaves_no_trace() -> None:
    plain, loaded = URSimulation("ur5"), URSimulation("ur5")
    loaded.set_payload(3.0)
    loaded.set_payload(0.0)
    for sim in (plain, loaded):
        sim.place(START)
        for _ in range(20):
            sim.command(START + 0.3)
            sim.advance()
    assert (plain.joint_positions == loaded.joint_positions).all()
    with pytest.raises(ValueError, match="the payload is 36 kg: expected 0 to 35 kg"):
        loaded.set_payload(36.0)
