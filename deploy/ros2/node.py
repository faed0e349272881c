"""The node around a policy: services, heartbeat, and the loop from messages to commands."""

from __future__ import annotations

import contextlib
import logging
import re
import threading
import time
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from typing import Any

import numpy as np

from rlservo.bundle.contract import Contract
from rlservo.deploy.ros2.mapped_elements import (
    COMMANDED,
    READ,
    ElementInputs,
    ElementOutputs,
    PresentPositions,
    check_conventions,
    places,
)
from rlservo.deploy.ros2.parameters import MAPPED
from rlservo.deploy.ros2.targets import GivenTarget, Targets
from rlservo.drive.driven_episode import report_step, reward_input
from rlservo.drive.environment_fit import check_fit
from rlservo.drive.make_environment import make_env
from rlservo.drive.real_robot_gate import check_proven
from rlservo.errors import DeadlineError, RlservoError, UsageError
from rlservo.policy.acting_policy import ActingPolicy
from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_states import Change, ControlState
from rlservo.robots.operator_terminal import Operator
from rlservo.robots.ros2.link import take_command
from rlservo.robots.ros2.rclpy_link import RclpyLink
from rlservo.robots.ros2.ros_messages import DIAGNOSTICS, stamp
from rlservo.robots.ur.parameters import JOINTS

HEARTBEAT_S = 0.5
STANDS = 0.01  # [rad/s], [m/s]
BRAKING_S = 3.0  # from full speed, and a slow machine
STOPPED = "the robot has stopped; call the start service first"
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"  # DiagnosticStatus' levels
LEVELS = {
    **dict.fromkeys(("holding", "hold", "blocked", "waiting", "refused", "human"), WARN),
    **dict.fromkeys(("failed", "fault"), ERROR),
}
# Environments of ours by the simulated one that a policy was trained in, and the frame of their target.
REAL = {
    "EndEffectorPositioningURSim-v0": ("EndEffectorPositioningURRob-v0", "ee_target_pose", "base_link"),
    "NoObstacleNavigationMir100Sim-v0": ("NoObstacleNavigationMir100Rob-v0", "target_pose", "odom"),
    "ObstacleAvoidanceMir100Sim-v0": ("ObstacleAvoidanceMir100Rob-v0", "target_pose", "odom"),
}

# The same of those whose targets this node does not take: they have orientations.
BY_ROLLOUT = {"IsaacDeployReachURSim-v0": "IsaacDeployReachURRob-v0"}

# Arguments of a policy's environment that say what its elements mean, and which robot it is for.
MEANINGS = ("ur_model", "restrict_wrist_1", "action_cycle_rate", "max_velocity_scale_factor", *(
    f"fix_{joint}" for joint in JOINTS
))  # fmt: skip

NUMBER = re.compile(r"[\d.]+")  # an age, say: it differs in each cycle
log = logging.getLogger("rlservo.ros2")


def real_environment(contract: Contract) -> tuple[str, dict[str, Any]] | None:
    """Return the simulated environment of ours that a policy was trained in and its arguments; None for others."""
    config, name = contract.provenance.env_config, _trained_in(contract)
    return (name, {key: config[key] for key in MEANINGS if key in config}) if name in REAL else None


def check_takes_targets(contract: Contract) -> None:
    """Raise UsageError for a policy of a built-in environment that has a robot, which this node does not drive."""
    if real := BY_ROLLOUT.get(_trained_in(contract)):
        raise UsageError(
            f"the targets of policy {contract.name!r} have orientations, which this node does not take: drive it by "
            f"rlservo rollout rlservo/{real} --env-arg robot=ros2: or map its elements (--mapping)"
        )


def _trained_in(contract: Contract) -> str:
    config = contract.provenance.env_config
    return str(config.get("env_id") or contract.provenance.env_id).rpartition("/")[2]


class Wanted(str, Enum):
    """The last request of the services."""

    RUN = "run"
    HOLD = "hold"
    STOP = "stop"


class PolicyNode:
    """A node `rlservo`, driven until `stop` is set. Its services answer at once, the loop follows."""

    def __init__(self, policy: ActingPolicy, link: RclpyLink, *, autostart: bool) -> None:
        """Offer the services on a node of the graph."""
        self.policy, self.link = policy, link
        self.stop = threading.Event()
        self.on_connected: Callable[[], object] = lambda: None  # before, nothing looks at `stop`
        self.state, self.why = "waiting", ""
        self.counts: dict[str, int] = {"decisions": 0, "episodes": 0, "successes": 0, "held": 0, "late": 0}
        self.wanted = Wanted.RUN if autostart else Wanted.STOP
        self.starts = 0  # calls of the start service: a person's
        self._diagnose = self.link.advertise("/diagnostics", DIAGNOSTICS)
        self._is_closed = threading.Event()
        for word in Wanted:
            self.link.serve(f"~/{'start' if word is Wanted.RUN else word.value}", self._setter(word))
        contract = policy.contract
        self.link.serve("~/version", lambda: (True, f"{contract.name} {self.policy.contract.version}"))
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._thread.start()

    def mapped(self) -> dict[str, str]:
        """Return the parameters that map elements: `observation.NAME`, `action.NAME` and `stop.NAME`."""
        return {name: str(value) for name, value in self.link.parameters().items() if name.startswith(MAPPED)}

    def enter(self, state: str, why: str = "") -> None:
        """Change the state: a line in the log where more than a number of it is new, and the next heartbeat."""
        if (state, NUMBER.sub("", why)) != (self.state, NUMBER.sub("", self.why)):
            log.info("node: %s -> %s%s", self.state, state, f": {why}" if why else "")
        self.state, self.why = state, why

    def close(self) -> None:
        """End the heartbeat."""
        self._is_closed.set()
        self._thread.join()

    def _setter(self, word: Wanted) -> Callable[[], tuple[bool, str]]:
        def answer() -> tuple[bool, str]:
            self.wanted = word
            self.starts += word is Wanted.RUN
            return True, f"{word.value} (was {self.state})"

        return answer

    def _beat(self) -> None:
        while not self._is_closed.wait(HEARTBEAT_S):
            contract = self.policy.contract
            facts = {"state": self.state, "policy": contract.name, "version": contract.version, **self.counts}
            level = LEVELS.get(self.state, OK)
            status = {
                "level": level,
                "name": f"{self.link.node.get_fully_qualified_name()}: policy",
                "message": f"{self.state}: {self.why}" if self.why else self.state,
                "hardware_id": contract.name,
                "values": [{"key": key, "value": str(value)} for key, value in facts.items()],
            }
            self._diagnose({"header": {"stamp": stamp(self.link.now_s())}, "status": [status]})


def drive_elements(node: PolicyNode, *, rate_hz: float | None, max_age_s: float | None) -> None:
    """Drive a robot by the contract's element names until the node is stopped. Raises UsageError, RobotError."""
    contract = node.policy.contract
    rate_hz = rate_hz or contract.control_rate_hz
    if rate_hz is None:
        raise UsageError(f"policy {contract.name!r} states no control rate: give --rate")
    observed, acted = places(contract, node.mapped())
    for side, numbers in ((observed, READ), (acted, COMMANDED)):
        for place in side:
            place.check(numbers)
    check_conventions(contract, observed, acted, node.link.node.resolve_topic_name)
    present = PresentPositions.of(contract, observed)
    inputs = ElementInputs(node.link, observed, max_age_s or max(0.1, 2.0 / rate_hz))
    kinds, name_of = {place.topic: place.kind for place in acted}, node.link.node.resolve_topic_name
    publishers = {topic: take_command(node.link, name_of(topic), kind)[1] for topic, kind in kinds.items()}
    outputs = ElementOutputs(acted, publishers, node.link.now_s)
    node.on_connected()
    try:
        _drive_elements(node, inputs, outputs, present, rate_hz)
    finally:
        with contextlib.suppress(RobotError):  # another node commands it now
            outputs.stop()


def _drive_elements(
    node: PolicyNode, inputs: ElementInputs, outputs: ElementOutputs, present: PresentPositions, rate_hz: float
) -> None:
    policy = node.policy
    due, was_running = time.monotonic(), False
    while not node.stop.is_set():
        is_acting = False
        due = max(due + 1.0 / rate_hz, time.monotonic())
        observation, why = inputs.observe()
        if node.wanted is not Wanted.RUN:
            node.enter("stopped" if node.wanted is Wanted.STOP else "holding", "asked for")
            was_running = was_running and node.wanted is Wanted.HOLD
        elif observation is None:
            node.enter("holding" if was_running else "waiting", why)
            node.counts["held"] += was_running
        else:
            if not was_running:
                policy.reset()
                node.counts["episodes"] += 1
            was_running = True
            began = time.monotonic()
            try:
                action = np.asarray(policy.act(observation))
                if (took_s := time.monotonic() - began) > inputs.max_age_s:
                    raise DeadlineError(f"the action took {took_s:.2f} s: expected at most {inputs.max_age_s:g} s")
                outputs.act(present.targets(action, observation))
                is_acting = True
                node.enter("running")
                node.counts["decisions"] += 1
            except RlservoError as error:  # late, unreachable, refused
                node.enter("holding", error.message)
                node.counts["late"] += 1
        if not is_acting:
            outputs.stop()
        time.sleep(max(0.0, due - time.monotonic()))


def drive_environment(node: PolicyNode, trained_in: str, arguments: Mapping[str, Any], *, unproven: bool) -> None:
    """Drive one of our robots to each target on `~/target` until the node is stopped. Raises UsageError, RobotError."""
    real_id, option, frame = REAL[trained_in]
    env = make_env(f"rlservo/{real_id}", arguments, render=False)
    try:
        node.on_connected()
        check_fit(node.policy.contract, env, arguments)
        if not unproven:
            check_proven(node.policy.contract, env)
        robot: Any = env.unwrapped.robot  # type: ignore[attr-defined]
        targets = Targets(node.link, robot.frame if frame == "odom" else frame, partial(_refusal, node))
        for word, to_person in (("take_over", True), ("hand_back", False)):
            node.link.serve(f"~/{word}", partial(_lead, robot.operator, to_person=to_person))
        robot.states.on_change = partial(_say_hold, node)
        robot.is_called_off = lambda: node.stop.is_set() or node.wanted is not Wanted.RUN or targets.newest.is_cancelled
        try:
            _drive_to_targets(node, env, option, targets)
        finally:
            if targets.is_due and targets.newest.goal is not None:
                _brake(env)
            targets.close()
    finally:
        env.close()


def _drive_to_targets(node: PolicyNode, env: Any, option: str, targets: Targets) -> None:
    robot = env.unwrapped.robot
    starts = node.starts
    while not node.stop.is_set():
        target = targets.newest
        if node.state != "fault":
            starts = node.starts
        elif node.starts > starts:
            robot.operator.allow_restart()
            node.enter("waiting", "started again")
            robot.stopped_by = None
        else:
            if targets.is_due:
                log.warning("node: a target was ignored: %s", STOPPED)
                targets.end(target, "abort", STOPPED)
            robot.advance()
            continue
        if targets.is_due and target.is_cancelled:
            _brake(env)
            targets.end(target, "canceled")
            if node.wanted is Wanted.RUN and not robot.is_led:
                node.enter("waiting", "the goal was cancelled")
        elif node.wanted is not Wanted.RUN:
            node.enter("stopped" if node.wanted is Wanted.STOP else "holding", "asked for")
            if node.wanted is Wanted.STOP and target.goal is not None and targets.is_due:
                _brake(env)
                targets.end(target, "abort", "the stop service was called")
        elif robot.is_led:
            node.enter(robot.states.state.value)
        elif not targets.is_due:
            if robot.stopped_by is not None:  # while it stood
                node.enter("fault", robot.stopped_by)
            elif node.state not in ("arrived", "failed", "refused"):
                node.enter("waiting", f"no new target on {node.link.node.resolve_topic_name('~/target')}")
        else:
            _drive_to(node, env, option, targets, target)
            continue
        robot.advance()  # the model stays where the robot is


def _refusal(node: PolicyNode) -> str:
    """Return why no goal can be accepted now; empty if one can."""
    if node.wanted is not Wanted.RUN:
        return "the node is not started: call the start service first"
    return STOPPED if node.state == "fault" else ""


def _brake(env: Any) -> None:
    """Hold, and wait until the robot stands: a client may touch it once it has its result."""
    robot, shown = env.unwrapped.robot, env.unwrapped.simulation
    robot.hold()
    until_s = time.monotonic() + BRAKING_S
    while np.abs(shown.data.qvel).max() > STANDS and time.monotonic() < until_s:
        robot.advance()


def _say_hold(node: PolicyNode, change: Change) -> None:
    """Tell the heartbeat of a robot that holds, while the step waits for it; the drive tells the other states."""
    if change.state == ControlState.HOLD.value and node.state in ("running", "blocked"):
        node.enter(change.state, change.why)


def _lead(operator: Operator, *, to_person: bool) -> tuple[bool, str]:
    """Answer a service: let a person lead the robot once it is at rest, or give it back to the policy."""
    if operator.has_taken_over != to_person:
        operator.toggle()
    return True, "the state is human once the robot may be led" if to_person else "given back"


def _drive_to(node: PolicyNode, env: Any, option: str, targets: Targets, target: GivenTarget) -> None:
    """Drive to a target, which remains due if the drive is interrupted.

    As in a rollout an arm first returns to its start: that is where its policy was trained and proven. After an
    interruption it goes on from its present pose.
    """
    robot, policy = env.unwrapped.robot, node.policy
    number, is_arm = target.number, option == "ee_target_pose"
    goal = [*target.position[: 3 if is_arm else 2]]
    if not np.isfinite(goal).all():  # an arm would return to its start before it is noticed
        node.enter("refused", f"the target is {', '.join(f'{value:g}' for value in goal)} m: expected finite numbers")
        targets.end(target, "abort", node.why)
        return
    goal += [0.0] * ((6 if is_arm else 3) - len(goal))
    if targets.begun != number:
        node.enter("starting")
    options = {**env.unwrapped.reset_options(start="here" if targets.begun == number else "own"), option: goal}
    try:
        observation, _ = env.reset(options=options)
    except ValueError as error:
        if not robot.is_called_off():
            node.enter("fault" if isinstance(error, RobotError) else "refused", str(error))
            targets.end(
                target, "abort", str(error)
            )  # a robot must not move by itself: a new target is needed, after a fault a start too
        return
    targets.begun = number
    policy.reset()
    contract, reward, is_first = policy.contract, 0.0, True
    while not robot.is_called_off() and targets.newest is target:
        try:
            action = policy.act(observation, **reward_input(contract, reward))
        except RlservoError as error:
            node.enter("holding", error.message)
            node.counts["late"] += 1
            robot.hold()
            robot.advance()
            return
        node.counts["episodes"] += is_first
        is_first = False
        step = env.step(action)
        report_step(policy, step)
        observation, reward, terminated, truncated, info = step
        node.counts["decisions"] += 1
        targets.tell(target, *_whereabouts(env.unwrapped, is_arm))
        state, blocked = info["robot"]["state"], info["robot"].get("blocked", "")
        if terminated or truncated:
            robot.hold()
            node.counts["successes"] += bool(info["is_success"])
            log.info("node: target %d: %s", number, info["final_status"])
            if robot.stopped_by is not None:
                causes = [change["why"] for change in info["robot"].get("changes", []) if change["state"] == "fault"]
                node.enter("fault", (causes or [info["final_status"]])[-1])
            elif info["is_success"]:
                node.enter("arrived", info["final_status"])
            else:
                node.enter("failed", info["final_status"] + (f", blocked: {blocked}" if blocked else ""))
            if target.goal is not None:
                _brake(env)
            targets.end(target, "succeed" if node.state == "arrived" else "abort", f"{node.state}: {node.why}")
            return
        if state in ("run", "blend_in"):
            node.enter("blocked" if blocked else "running", blocked)
        else:
            node.enter(state)
    robot.hold()


def _whereabouts(env: Any, is_arm: bool) -> tuple[tuple[float, float, float], float]:
    """Return the robot's place in the frame of targets [m], and its distance from the target [m]."""
    away = env.target_position() - env.robot_position()
    if is_arm:
        x, y, z = env.simulation.tool_position.tolist()
        return (x, y, z), float(np.linalg.norm(away))
    x, y, _ = env.simulation.pose
    return (x, y, 0.0), float(np.linalg.norm(away[:2]))
