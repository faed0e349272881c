"""The roslaunch lines of robo-gym's own environments, and what is refused in them."""

from __future__ import annotations

import random
import time

import pytest

from rlservo.envs.robot_server.launch_line import parse_launch_line
from rlservo.envs.robot_server.robot_server_settings import (
    Mir100Settings,
    PandaSettings,
    Settings,
    URSettings,
    settings_from_json,
    settings_to_json,
)

UR = "roslaunch ur_robot_server ur_robot_server.launch"
MIR = "roslaunch mir100_robot_server sim_robot_server.launch"
POSITIONING = f"""{UR} \
        world_name:=tabletop_sphere50_no_collision.world \
        reference_frame:=base_link \
        max_velocity_scale_factor:=0.1 \
        action_cycle_rate:=10 \
        rviz_gui:=true \
        gazebo_gui:=true \
        objects_controller:=true \
        rs_mode:=1object \
        n_objects:=1.0 \
        object_0_model_name:=sphere50_no_collision \
        object_0_frame:=target ur_model:=ur10e gui:=false server_port:=50321"""

# robo-gym 2.1's, its own line ends and all.
ISAAC = f"""{UR}             rviz_gui:=True             gazebo_gui:=True \
            world_name:=isaactabletop_sphere50_no_collision.world             reference_frame:=base_link \
            ee_frame:=tool1             max_velocity_scale_factor:=0.2             action_cycle_rate:=30.0 \
            objects_controller:=true             rs_mode:=1object             n_objects:=1.0 \
            object_0_model_name:=sphere50_no_collision             object_0_frame:=target             z:=0.0 \
            ur_model:=ur10"""
PANDA = """roslaunch panda_robot_server panda_robot_server.launch         rviz_gui:=True         gazebo_gui:=True \
        world_name:=tabletop_sphere50_no_collision_no_gravity.world         reference_frame:=world \
        max_velocity_scale_factor:=0.2         action_cycle_rate:=30.0         objects_controller:=true \
        rs_mode:=1object         action_mode:=abs_pos        n_objects:=1.0 \
        object_0_model_name:=sphere50_no_collision         object_0_frame:=target """


def test_positioning_line_of_robo_gym_is_understood() -> None:
    assert parse_launch_line(POSITIONING, gui=True, clock="real", host="0.0.0.0") == URSettings(
        host="0.0.0.0",
        port=50321,
        clock="real",
        gui=True,
        ur_model="ur10e",
        rs_mode="1object",
        reference_frame="base_link",
        action_cycle_rate=10.0,
        max_velocity_scale_factor=0.1,
        world="tabletop_sphere50_no_collision.world",
        objects=("sphere50_no_collision",),
    )


def test_lines_of_robo_gym_2_1_are_understood() -> None:
    reach, panda = parse_launch_line(ISAAC), parse_launch_line(PANDA)
    assert isinstance(reach, URSettings) and isinstance(panda, PandaSettings)
    assert (reach.ur_model, reach.ee_frame, reach.table, reach.action_cycle_rate) == ("ur10", "tool1", "isaac", 30.0)
    assert (panda.reference_frame, panda.action_mode, panda.table) == ("world", "abs_pos", True)
    for settings in (reach, panda):
        assert settings.object_names == ("sphere50_no_collision",)
        assert settings_from_json(settings_to_json(settings)) == settings
    bare = parse_launch_line("roslaunch panda_robot_server panda_robot_server.launch")
    assert isinstance(bare, PandaSettings)
    assert (bare.action_mode, bare.table, bare.max_velocity_scale_factor) == ("delta_pos", False, 1.0)


def test_what_is_left_out_has_the_launch_files_defaults() -> None:
    settings = parse_launch_line(f"{UR} ur_model:=ur3")
    assert isinstance(settings, URSettings)
    assert (settings.rs_mode, settings.reference_frame, settings.object_names) == ("only_robot", "base", ())
    assert (settings.action_cycle_rate, settings.max_velocity_scale_factor) == (25.0, 1.0)
    assert not settings.table
    mir = parse_launch_line(MIR)
    assert isinstance(mir, Mir100Settings)
    assert mir.world_name == "empty"


def test_mir100_and_two_object_lines_are_understood() -> None:
    mir = parse_launch_line(f"{MIR} world_name:=lab_6x8.world gazebo_gui:=true")
    assert isinstance(mir, Mir100Settings)
    assert mir.world_name == "lab_6x8"
    two = parse_launch_line(
        f"{UR} ur_model:=ur5 rs_mode:=2objects2points objects_controller:=true n_objects:=2.0 action_mode:=delta_pos "
        "object_0_model_name:=green_sphere50_no_collision object_0_frame:=target object_1_model_name:=sphere50 "
        "object_1_frame:=obstacle1 world_name:=tabletop_sphere50_green_sphere50_no_collision.world"
    )
    assert isinstance(two, URSettings)
    assert two.object_names == ("green_sphere50_no_collision", "sphere50")
    assert two.action_mode == "delta_pos"
    assert two.table


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "expected 'roslaunch <package> <launch file> name:=value"),
        ("rm -rf /", "the line is 'rm -rf /': expected 'roslaunch"),
        ("roslaunch 'ur_robot_server", "cannot be split into words: No closing quotation"),
        ("roslaunch sawyer_robot_server x.launch", "package 'sawyer_robot_server' is not known: expected one of ur_r"),
        (
            PANDA.replace("abs_pos", "abs"),
            "action_mode 'abs' does not exist: expected one of abs_pos, delta_pos, abs_v",
        ),
        (f"{PANDA} ee_frame:=tool1", "ee_frame 'tool1' does not exist: expected one of panda_hand"),
        (f"{PANDA} subsampling_factor:=2", "subsampling_factor:=2 is not simulated: expected subsampling_factor:=1"),
        (ISAAC.replace("z:=0.0", "z:=0.1"), "z:=0.1 is not simulated: expected z:=0.0"),
        (f"{UR} ur_model:=ur5 ee_frame:=tool2", "ee_frame 'tool2' does not exist: expected one of tool0, tool1"),
        ("roslaunch ur_robot_server ur99.launch", "launch file 'ur99.launch' of ur_robot_server is not known"),
        (UR, "the argument ur_model is missing"),
        (f"{UR} ur_model:=ur7", "ur_model 'ur7' does not exist: expected one of ur3, ur3e"),
        (
            f"{UR} ur_model:=ur5 speed:=9 colour:=red",
            "unknown launch arguments: speed, colour; expected some of action_cyc",
        ),
        (f"{UR} ur_model:=ur5 ; rm -rf /", "';' is not a launch argument: expected name:=value"),
        (f"{UR} ur_model:=ur5 --screen", "'--screen' is not a launch argument"),
        (f"{UR} ur_model:=ur5 rs_mode:=voxels", "rs_mode 'voxels' does not exist: expected one of only_robot"),
        (f"{UR} ur_model:=ur5 action_cycle_rate:=fast", "action_cycle_rate:=fast is not a number"),
        (f"{UR} ur_model:=ur5 action_cycle_rate:=-1", "action_cycle_rate is -1 Hz: expected 0.1 to 1000 Hz"),
        (f"{UR} ur_model:=ur5 max_velocity_scale_factor:=2", "expected more than 0, at most 1"),
        (f"{UR} ur_model:=ur5 world_name:=moon.world", "world 'moon.world' does not exist: expected one of empty"),
        (f"{UR} ur_model:=ur5 reference_frame:=world", "reference_frame 'world' does not exist"),
        (f"{UR} ur_model:=ur5 real_robot:=true", "real_robot:=true is not simulated: expected real_robot:=false"),
        (f"{UR} ur_model:=ur5 object_trajectory_file_name:=splines_ur5", "splines_ur5 is not simulated"),
        (f"{UR} ur_model:=ur5 z:=1.0", "z:=1.0 is not simulated: expected z:=0.1"),
        (f"{UR} ur_model:=ur5 rs_mode:=1object", "rs_mode '1object' needs 1 to 10 objects, and there are 0"),
        (f"{UR} ur_model:=ur5 objects_controller:=true n_objects:=1", "object_0_model_name is missing"),
        (f"{UR} ur_model:=ur5 objects_controller:=true n_objects:=1e9", "n_objects is 1e.09: expected a whole number"),
        (
            f"{UR} ur_model:=ur5 objects_controller:=true n_objects:=1 object_0_model_name:=duck",
            "object model 'duck' does not exist",
        ),
        (f"{UR} ur_model:=ur5 server_port:=99999", "port 99999 does not exist"),
        *(
            (f"{UR} ur_model:=ur5 server_port:={port}", "is not a port: expected a whole number, 0 .* to 65535")
            for port in ("inf", "-inf", "nan", "1e400", "50400.9", "50400.0", "-1", "٣", "", "9" * 400, "50_400")
        ),
        (f"{MIR} server_port:=inf", "server_port:=inf is not a port"),
        (f"{UR} ur_model:=ur5 'a\nb:=1'", r"'a\\nb:=1' is not a launch argument: expected name:=value"),
        (f"{UR} 'ur_model:=ur5\nERROR'", r"ur_model is 'ur5\\nERROR': expected at most 1,000 printable characters"),
        (f"{UR} ur_model:={'u' * 2000}", "expected at most 1,000 printable characters"),
        (
            f"{UR} " + " ".join(f"a{i}:=1" for i in range(400)),
            "unknown launch arguments: a0, a1, a2, a3, a4 and 395 more; expected",
        ),
        (f"{UR} object_{'1' * 1000}_frame:=x ur_model:=ur5", "unknown launch arguments: object_111"),
        (f"{MIR} world_name:=moon.world", "world 'moon.world' does not exist: expected one of empty_world_target"),
        (f"{MIR} ur_model:=ur5", "unknown launch arguments: ur_model"),
        (f"{MIR} robot_x:=1.0", "robot_x:=1.0 is not simulated"),
    ],
)
def test_line_that_cannot_be_honoured_is_refused_by_name(line: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_launch_line(line)


@pytest.mark.parametrize("filling", [" x:=" + "a" * 10**6, " a:=1" * 200_000, " " * 10**6, " '" + "a" * 10**6 + "'"])
def test_a_line_of_a_million_characters_is_refused_before_it_is_read(filling: str) -> None:
    began = time.process_time()
    with pytest.raises(ValueError, match=r"the line has 1,000,\d\d\d characters: expected at most 10,000"):
        parse_launch_line(f"{UR} ur_model:=ur5{filling}")
    assert time.process_time() - began < 0.5  # today's answer took 39 s


def test_whatever_a_line_holds_is_understood_or_refused_in_a_short_sentence() -> None:
    rng = random.Random(0)
    names = ["ur_model", "rs_mode", "server_port", "n_objects", "objects_controller", "action_cycle_rate", "world_name"]
    names += ["max_velocity_scale_factor", "object_0_model_name", "reference_frame", "z", "gui", "colour"]
    values = [
        "ur5",
        "1object",
        "inf",
        "-inf",
        "nan",
        "1e308",
        "1e-308",
        "-0",
        "50400.9",
        "9" * 50,
        "true",
        "",
        "sphere50",
    ]
    values += ["\x00", "\ud800", "\u2028", "'", '"', "\\", "a b", "$(rm)", "%n", "\x1b[31m", "0x10", "٣"]
    began = time.process_time()
    for _ in range(3_000):
        words = [f"{rng.choice(names)}{rng.choice((':=', ':=', ':=', '=', ''))}{rng.choice(values)}" for _ in range(6)]
        line = f"{rng.choice((UR, UR, MIR, 'roslaunch'))} {' '.join(words)}"
        try:
            parse_launch_line(line)
        except ValueError as error:
            assert len(str(error)) < 1_000
            assert str(error).isprintable(), line
    assert time.process_time() - began < 30.0


@pytest.mark.parametrize(
    "settings", [parse_launch_line(POSITIONING), URSettings(), Mir100Settings(world="lab_6x8", seed=3, clock="real")]
)
def test_settings_survive_the_way_to_another_process(settings: Settings) -> None:
    assert settings_from_json(settings_to_json(settings)) == settings
