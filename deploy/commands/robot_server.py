"""The commands `rlservo robot-server` and `rlservo server-manager`: options here, work in rlservo.envs.robot_server."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.environment_options import parse_env_arguments, require_robot
from rlservo.deploy.terminal import Json, print_json, show_log
from rlservo.errors import UsageError
from rlservo.extras import needs_extra
from rlservo.robots.ur.parameters import UR_PARAMETERS

if TYPE_CHECKING:
    from rlservo.envs.robot_server.robot_server_settings import Settings
    from rlservo.robots.latency import LatencyReport

robot_server = typer.Typer(
    help="Serve a robot to robo-gym, without ROS.",
    no_args_is_help=True,
)

MODELS = ", ".join(UR_PARAMETERS)
Host = Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for clients on other machines.")]
Clock = Annotated[
    Literal["fast", "real"],
    typer.Option(help="fast: at the simulation's full speed; real: in real time, as on the robot."),
]
RobotPort = Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes any free one.")]
Gui = Annotated[bool, typer.Option("--gui", help="Show the robot in a window; needs a display.")]
Seed = Annotated[
    int | None, typer.Option(help="Random seed of object paths and laser noise; differs every run by default.")
]


Limit = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="Real arm: a limit such as speed_scale=0.1 (docs/how-to/ur-arm.md); repeatable.",
    ),
]


@robot_server.command("ur")
def robot_server_ur(
    ur_model: Annotated[str, typer.Option(help=f"Model: {MODELS}.")] = "ur5",
    rs_mode: Annotated[
        str, typer.Option(help="Content of a state: only_robot, 1object, 1moving2points or 2objects2points.")
    ] = "only_robot",
    action_mode: Annotated[
        str, typer.Option(help="abs_pos: actions are joint positions; delta_pos: offsets from the current ones.")
    ] = "abs_pos",
    action_cycle_rate: Annotated[float, typer.Option(help="Control cycles per second [Hz].")] = 25.0,
    max_velocity_scale_factor: Annotated[
        float, typer.Option(help="Share of the joints' velocity limits to use.")
    ] = 1.0,
    world: Annotated[str, typer.Option(help="World: empty, or a tabletop world of robo-gym.")] = "tabletop",
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="Object model in the scene, such as sphere50; repeat it for more. Depends on --rs-mode by default.",
        ),
    ] = None,
    robot: Annotated[
        str, typer.Option(help="mujoco, or a real arm: rtde://192.168.0.2 (extra 'ur'; docs/how-to/ur-arm.md first).")
    ] = "mujoco",
    limit: Limit = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Real arm: move to SetState's poses without confirmation at this terminal.")
    ] = False,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Real arm: address at which Prometheus reads its state and limits."),
    ] = None,
    reference_frame: Annotated[
        str, typer.Option(help="Frame: base_link (simulation) or base (the real controller's).")
    ] = ("base_link"),
    ee_frame: Annotated[str, typer.Option(help="End effector: tool0, or Isaac Lab's tool1.")] = "tool0",
    host: Host = "127.0.0.1",
    port: RobotPort = 50051,
    clock: Clock = "fast",
    gui: Gui = False,
    seed: Seed = None,
) -> None:
    """Serve a UR arm until Ctrl-C.

    Example: `rlservo robot-server ur --ur-model ur5 --rs-mode 1object --action-cycle-rate 10 --port 50051`, then
    `gym.make("EndEffectorPositioningURRob-v0", rs_address="127.0.0.1:50051", ur_model="ur5")` in robo-gym
    """
    with one_sentence_errors():
        from rlservo.envs.robot_server.robot_server_settings import URSettings

        settings = URSettings(
            host=host,
            port=port,
            clock=clock,
            gui=gui,
            seed=seed,
            ur_model=ur_model,
            rs_mode=rs_mode,
            action_mode=action_mode,
            reference_frame=reference_frame,
            ee_frame=ee_frame,
            action_cycle_rate=action_cycle_rate,
            max_velocity_scale_factor=max_velocity_scale_factor,
            world=world,
            objects=None if model is None else tuple(model),
            robot=robot,
            confirm=not yes,
            metrics=metrics,
            limits=parse_env_arguments(limit or []),
        )
        _serve(settings, f"{ur_model}, {rs_mode}, {action_mode}, {action_cycle_rate:g} Hz")


@robot_server.command("panda")
def robot_server_panda(
    rs_mode: Annotated[str, typer.Option(help="Content of a state: only_robot or 1object.")] = "only_robot",
    action_mode: Annotated[
        str, typer.Option(help="abs_pos or delta_pos: joint positions; abs_vel or delta_vel: velocities.")
    ] = "abs_pos",
    action_cycle_rate: Annotated[float, typer.Option(help="Control cycles per second [Hz].")] = 30.0,
    max_velocity_scale_factor: Annotated[
        float, typer.Option(help="Share of the joints' velocity limits to use.")
    ] = 0.2,
    world: Annotated[str, typer.Option(help="World: empty, or a tabletop world of robo-gym.")] = "tabletop",
    host: Host = "127.0.0.1",
    port: RobotPort = 50051,
    clock: Clock = "fast",
    gui: Gui = False,
    seed: Seed = None,
) -> None:
    """Serve a Panda until Ctrl-C.

    Example: `rlservo robot-server panda --rs-mode 1object --port 50051`, then
    `gym.make("EndEffectorPositioningPandaRob-v0", rs_address="127.0.0.1:50051")` in robo-gym 2.1
    """
    with one_sentence_errors():
        from rlservo.envs.robot_server.robot_server_settings import PandaSettings

        settings = PandaSettings(
            host=host,
            port=port,
            clock=clock,
            gui=gui,
            seed=seed,
            rs_mode=rs_mode,
            action_mode=action_mode,
            action_cycle_rate=action_cycle_rate,
            max_velocity_scale_factor=max_velocity_scale_factor,
            world=world,
        )
        _serve(settings, f"panda, {rs_mode}, {action_mode}, {action_cycle_rate:g} Hz")


@robot_server.command("mir100")
def robot_server_mir100(
    world: Annotated[str, typer.Option(help="World: empty or lab_6x8.")] = "empty",
    host: Host = "127.0.0.1",
    port: RobotPort = 50051,
    clock: Clock = "fast",
    gui: Gui = False,
    seed: Seed = None,
) -> None:
    """Serve a MiR100 until Ctrl-C.

    Example: `rlservo robot-server mir100 --world lab_6x8 --port 50051`
    """
    with one_sentence_errors():
        from rlservo.envs.robot_server.robot_server_settings import Mir100Settings

        settings = Mir100Settings(host=host, port=port, clock=clock, gui=gui, seed=seed, world=world)
        _serve(settings, f"MiR100, world {world}, 10 Hz")


def server_manager(
    host: Host = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port; the first free one of 50100 to 50199 by default.")
    ] = None,
    clock: Clock = "fast",
    max_servers: Annotated[int, typer.Option(min=1, help="Largest number of robot servers at once.")] = 100,
    orphan_timeout: Annotated[
        float, typer.Option(min=0.0, help="Seconds without a client after which a robot server exits; 0: never.")
    ] = 120.0,
) -> None:
    """Start robot servers for robo-gym's Sim environments. Runs until Ctrl-C, in place of the ROS server manager.

    Example: `rlservo server-manager`, then
    `gym.make("EndEffectorPositioningURSim-v0", ip="127.0.0.1", ur_model="ur5")` in robo-gym
    """
    with one_sentence_errors():
        from rlservo.envs.robot_server.manager import serve_manager

        def ready(bound: int) -> None:
            terminal.output().print(
                f"server manager on {host}:{bound}, clock {clock}; Ctrl-C stops it", highlight=False
            )

        serve_manager(
            host=host,
            port=port,
            clock=clock,
            max_servers=max_servers,
            orphan_s=orphan_timeout or None,
            on_ready=ready,
        )


def robot_latency(
    robot: Annotated[str, typer.Argument(metavar="ADDRESS", help="rtde://HOST, or ros2:NAME=VALUE,...")],
    ur_model: Annotated[str, typer.Option(help=f"Model: {MODELS}.")] = "ur5e",
    control_rate: Annotated[float, typer.Option(min=0.1, help="The policy's rate [Hz].")] = 10.0,
    steps: Annotated[int, typer.Option(min=5, help="Motions to measure.")] = 20,
    hours: Annotated[
        float, typer.Option(min=0.0, help="Measure for at least this many hours, to find rare delays.")
    ] = 0.0,
    limit: Limit = None,
    yes: Annotated[bool, typer.Option("--yes", help="Move without confirmation.")] = False,
    as_json: Json = False,
) -> None:
    """Measure a real arm's latency. Prints the evaluation that a policy for this arm must pass.

    Measures from command to motion: wrist_3 turns by 0.05 rad, back and forth. `--json` has histograms.

    Example: `rlservo robot-latency rtde://192.168.0.2 --ur-model ur5e`
    """
    require_robot(robot)
    with one_sentence_errors():
        from rlservo.robots.arm_interface import RobotError, host_of
        from rlservo.robots.arm_process import ArmProcess
        from rlservo.robots.kept_latency import keep_latency_ms
        from rlservo.robots.latency import STEP, measure_latency
        from rlservo.robots.limits import Limits
        from rlservo.robots.operator_terminal import Operator

        host = host_of(robot)
        if host is None:
            raise RobotError(f"robot {robot!r} is simulated: expected rtde://HOST or ros2:")
        often = f"for {hours:g} hours" if hours else f"{steps} times"
        Operator(is_asked=not yes).confirm(f"wrist_3 of the robot at {host} turns by {STEP:g} rad, {often}")
        arm = ArmProcess(host, ur_model, setpoint_timeout_s=0.5, limits=Limits.of(parse_env_arguments(limit or [])))
        try:
            all_of = "" if hours else f" of {steps}"
            with terminal.status(f"0{all_of} motions") as show:
                report = measure_latency(
                    arm,
                    steps=steps,
                    hours=hours,
                    control_rate_hz=control_rate,
                    on_step=lambda done: show(f"{done}{all_of} motions"),
                )
        finally:
            arm.close()
        if not report.fault:
            keep_latency_ms(robot, ur_model, report.max_ms)
    if as_json:
        print_json(dataclasses.asdict(report) | {"disturbance": report.disturbance})
    else:
        _print_latency(report, control_rate, ur_model)
    if report.fault:
        raise UsageError(f"the measurement ended after {report.steps} motions: {report.fault}")


def _print_latency(report: LatencyReport, control_rate: float, ur_model: str) -> None:
    motions, periods = report.latencies, report.periods
    terminal.output().print(
        f"command to motion: p50 {report.p50_ms:.0f}, p95 {report.p95_ms:.0f}, p99 {motions.p99_ms:.0f}, p99.9 "
        f"{motions.p999_ms:.0f}, max {report.max_ms:.0f} ms, jitter {report.jitter_ms:.0f} ms over {report.steps} "
        f"motions; a state every {report.state_period_ms:.3g} ms; joints at rest within {report.noise:.1e} rad\n"
        f"command to command: p50 {periods.p50_ms:.3g}, p99 {periods.p99_ms:.3g}, p99.9 {periods.p999_ms:.3g}, max "
        f"{periods.longest_ms:.3g} ms over {sum(periods.counts):,} setpoints, "
        f"{'with' if report.is_realtime else 'without'} a PREEMPT_RT kernel\n"
        f"at {control_rate:g} Hz this is up to {report.cycles} cycles. The policy must pass:\n"
        f"rlservo verify BUNDLE {report.disturbance} --disturb --write "
        f"--env rlservo/EndEffectorPositioningURSim-v0 --env-arg ur_model={ur_model}",
        highlight=False,
        soft_wrap=True,
    )


def ur_controller(
    model: Annotated[str, typer.Option(help=f"{MODELS}; 500 Hz, except ur3, ur5 and ur10 (125 Hz).")] = "ur5e",
    host: Annotated[
        str, typer.Option(help="Address to listen on; the ports are always 29999 and 30001 to 30004.")
    ] = "127.0.0.1",
    latency_ms: Annotated[float, typer.Option(min=0.0, help="Delay of the link in each direction.")] = 0.0,
    jitter_ms: Annotated[float, typer.Option(min=0.0, help="Largest additional delay (jitter).")] = 0.0,
    drop: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of RTDE data packages that are lost.")] = 0.0,
    calibrated: Annotated[
        bool,
        typer.Option("--calibrated", help="Kinematics a few millimetres off the data sheet's, like a real arm's."),
    ] = False,
) -> None:
    """Run the controller of a simulated UR arm until Ctrl-C. Lines on standard input stop the arm or cut the link.

    Example: `rlservo ur-controller --model ur5e`, then `rtde_control.RTDEControlInterface("127.0.0.1")` in Python;
    `help` and Enter lists the commands
    """
    with one_sentence_errors():
        from rlservo.robots.simulated.ur_controller.console import run
        from rlservo.robots.simulated.ur_controller.controller import DEVIATIONS, Controller
        from rlservo.robots.simulated.ur_controller.controller_server import LinkFaults
        from rlservo.robots.ur.calibration import data_sheet

        def ready() -> None:
            terminal.output().print(
                f"{model} controller on {host}, ports 29999 and 30001 to 30004; help lists its commands, "
                "Ctrl-C stops it",
                highlight=False,
                soft_wrap=True,
            )

        stop = threading.Event()
        with terminal.ctrl_c_sets(stop):
            kinematics = data_sheet(model) + DEVIATIONS if calibrated else None
            run(
                Controller(model, kinematics=kinematics),
                host,
                LinkFaults(latency_ms / 1e3, jitter_ms / 1e3, drop),
                stop,
                ready,
            )


def _serve(settings: Settings, title: str) -> None:
    from rlservo.envs.robot_server.robot_server import serve_robot

    def ready(port: int) -> None:
        terminal.output().print(f"robot server on {settings.host}:{port}: {title}; Ctrl-C stops it", highlight=False)

    serve_robot(settings, on_ready=ready)


@contextmanager
def one_sentence_errors() -> Iterator[None]:
    """Convert the simulators' errors to those of the command line, and name a missing extra."""
    show_log()
    try:
        with needs_extra("sim", "mujoco", "grpc"):
            yield
    except ValueError as error:
        raise UsageError(str(error)) from error
