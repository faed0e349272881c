"""The commands `rlservo ros2` and `rlservo ros2-sim`."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.environment_options import parse_env_arguments
from rlservo.deploy.commands.rollout import TransportKind, VersionOrAlias, acting_policy, with_fallback
from rlservo.errors import UsageError
from rlservo.extras import needs_extra, require

if TYPE_CHECKING:
    from rlservo.robots.ros2.link import Topics


def ros2(
    bundle: Annotated[Path | None, typer.Option(help="Act in process with this bundle.")] = None,
    version: VersionOrAlias = None,
    url: Annotated[str | None, typer.Option(help="Server that gives the actions.")] = None,
    policy: Annotated[str | None, typer.Option(help="Policy name on that server; by default its only policy.")] = None,
    robot: Annotated[
        str, typer.Option(help="Address of a supported arm or base: ros2:NAME=VALUE,... (topics, prefix, command).")
    ] = "ros2:",
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Environment argument: ur_model=ur5e, limits={...}.")
    ] = None,
    mapping: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="ROS 2 parameter file that maps elements to message fields."),
    ] = None,
    name: Annotated[str, typer.Option(help="The node's name.")] = "rlservo",
    rate: Annotated[
        float | None, typer.Option(min=0.1, help="Mapped elements: control rate [Hz], instead of the contract's.")
    ] = None,
    max_age: Annotated[
        float | None, typer.Option(min=0.01, help="Mapped elements: age [s] beyond which an input is not used.")
    ] = None,
    autostart: Annotated[bool, typer.Option("--autostart", help="Start without a call to the start service.")] = False,
    transport: Annotated[TransportKind, typer.Option(help="With --url: http or ws.")] = "http",
    deadline_ms: Annotated[float | None, typer.Option(help="With --url: deadline for each action.")] = None,
    fallback: Annotated[
        str | None, typer.Option(metavar="hold|zero|stop|ACTION", help="With --url: replacement for a late action.")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Record into a new .mcap file or a folder.")] = None,
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Accept a policy that was not proven under latency.")
    ] = False,
    ros_args: Annotated[
        list[str] | None, typer.Argument(metavar="--ros-args ...", help="Remappings and parameters, as for any node.")
    ] = None,
) -> None:
    """Drive a robot as a ROS 2 node until Ctrl-C.

    A policy of a built-in environment drives its robot to each pose on ~/target, or goal of ~/navigate_to_pose. Any
    other policy's observation and action elements are mapped to message fields, by name or by --mapping. Services:
    ~/start, ~/hold, ~/stop, ~/version; heartbeat: /diagnostics. Each option but --name and --mapping is a parameter of
    the node as well; the option wins.

    Example: `rlservo ros2 --bundle policies/ur_positioning --env-arg ur_model=ur5e`
    """
    given = {option: value for option, value in locals().items() if option not in ("mapping", "name", "ros_args")}
    terminal.show_log()
    _pass_ros_arguments(ros_args or [], mapping)
    with needs_extra("sim", "mujoco", "gymnasium"):
        from rlservo.deploy.ros2.node import (
            PolicyNode,
            check_takes_targets,
            drive_elements,
            drive_environment,
            real_environment,
        )
        from rlservo.deploy.ros2.parameters import with_parameters
        from rlservo.robots.arm_interface import RobotError
        from rlservo.robots.ros2.rclpy_link import RclpyLink
    with ExitStack() as cleanup:
        cleanup.enter_context(terminal.ends_like_ctrl_c())  # until the robot is connected, which may take a minute
        try:
            link = RclpyLink(name, is_unique=True)
            cleanup.callback(link.close)
            cleanup.enter_context(link.has_log("rlservo"))
            chosen = with_parameters(link, ros2, given)
            acting = cleanup.enter_context(_opened(chosen))
            if chosen["record"] is not None:
                from rlservo.recording.start import record_policy

                acting = record_policy(acting, chosen["record"])
                cleanup.callback(acting.end)
            node = PolicyNode(acting, link, autostart=chosen["autostart"])
            cleanup.callback(node.close)
            node.on_connected = lambda: cleanup.enter_context(terminal.ctrl_c_sets(node.stop))
            terminal.note(f"node /{name}: policy {acting.contract.name} {acting.contract.version}; Ctrl-C ends it")
            ours = real_environment(acting.contract)
            if not node.mapped():
                check_takes_targets(acting.contract)
            if ours is not None and not node.mapped():
                arguments = ours[1] | parse_env_arguments(chosen["env_arg"] or [])
                arguments |= {"robot": chosen["robot"], "confirm": False}
                drive_environment(node, ours[0], arguments, unproven=chosen["unproven"])
            else:
                drive_elements(node, rate_hz=chosen["rate"], max_age_s=chosen["max_age"])
        except RobotError as error:
            raise UsageError(str(error)) from error


def _opened(chosen: dict[str, Any]) -> Any:
    url, bundle, record = chosen["url"], chosen["bundle"], chosen["record"]
    if (url is None) == (bundle is None):
        raise UsageError("expected either --url (a server) or --bundle (in process)")
    if record is not None:
        require("record", "mcap", "orjson")
    transport, deadline_ms = chosen["transport"], chosen["deadline_ms"]
    opened = acting_policy(url, chosen["policy"], bundle, chosen["version"], transport, deadline_ms, False, None)
    return with_fallback(opened, chosen["fallback"])


def ros2_sim(
    robot: Annotated[
        str, typer.Argument(metavar="ROBOT", help="Robot: mir100, or an arm (ur3e, ur5, ur5e, ur10e ...).")
    ],
    controller: Annotated[
        Literal["position", "velocity", "trajectory"], typer.Option(help="Arm: the active controller.")
    ] = "position",
    prefix: Annotated[str, typer.Option(help="Arm: prefix of the joint names.")] = "",
    calibrated: Annotated[
        bool, typer.Option("--calibrated", help="Arm: kinematics a few millimetres off the data sheet's.")
    ] = False,
    world: Annotated[str, typer.Option(help="Base: world, empty or lab_6x8.")] = "empty",
    twist: Annotated[Literal["Twist", "TwistStamped"], typer.Option(help="Base: type of /cmd_vel.")] = "Twist",
    rosbridge_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Base: offer a rosbridge on this port of 127.0.0.1; 0: any free port."),
    ] = None,
    ros: Annotated[bool, typer.Option("--ros/--no-ros", help="Base: join the ROS 2 graph.")] = True,
) -> None:
    """Simulate a robot with its ROS 2 topics until Ctrl-C.

    Lines on standard input stop it, move it or cut the link (`help` lists them).

    Example: `rlservo ros2-sim ur5e`, or without ROS `rlservo ros2-sim mir100 --no-ros --rosbridge-port 9090`
    """
    if robot == "mir100" and not ros and rosbridge_port is None:
        raise UsageError("--no-ros needs --rosbridge-port: otherwise the robot has no link")
    terminal.show_log()
    with needs_extra("sim", "mujoco"):
        from rlservo.robots.arm_interface import RobotError
        from rlservo.robots.simulated.ros2_loop import SimulatedRobot, run
        from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults as LinkFaults
    where = []
    stop = threading.Event()
    simulated: SimulatedRobot
    with ExitStack() as cleanup:
        try:
            if robot == "mir100":
                from rlservo.robots.simulated.ros2_base import SimulatedBase

                links: list[Topics] = []
                if ros:
                    from rlservo.robots.ros2.rclpy_link import RclpyLink

                    links.append(RclpyLink("mir100_sim", is_unique=True))
                    where.append("ROS 2")
                if rosbridge_port is not None:
                    with needs_extra("client", "websockets"):
                        from rlservo.robots.simulated.rosbridge_server import RosbridgeServer
                    bridge = RosbridgeServer("127.0.0.1", rosbridge_port)
                    links.append(bridge)
                    where.append(f"rosbridge://127.0.0.1:{bridge.port}")
                base = SimulatedBase(links, world=world, is_stamped=twist == "TwistStamped", faults=LinkFaults())
                simulated = base
                cleanup.callback(base.close)
            else:
                from rlservo.robots.simulated.ros2_arm import SimulatedArm
                from rlservo.robots.simulated.ur_controller.controller import DEVIATIONS
                from rlservo.robots.ur.calibration import data_sheet

                own = data_sheet(robot) + DEVIATIONS if calibrated else None
                arm = SimulatedArm(robot, controller=controller, prefix=prefix, faults=LinkFaults(), kinematics=own)
                simulated = arm
                cleanup.callback(arm.close)
                where.append(f"ROS 2, {controller} controller")
        except (RobotError, ValueError) as error:
            raise UsageError(str(error)) from error
        cleanup.enter_context(terminal.ctrl_c_sets(stop))
        run(
            simulated,
            stop,
            lambda: terminal.show(f"{robot} on {' and '.join(where)}; help and Enter lists commands, Ctrl-C ends it"),
            sys.stdin,
        )


def _pass_ros_arguments(words: list[str], mapping: Path | None) -> None:
    """Pass ROS's own arguments to the nodes of this process and of the processes that it starts."""
    rest = [word for word in words if word not in ("--ros-args", "--")]
    if mapping is not None:
        rest += ["--params-file", str(mapping.resolve())]
    if rest:
        os.environ["RLSERVO_ROS_ARGS"] = "\n".join(rest)
