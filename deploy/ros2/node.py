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
from rlservo.drive.driven_episode import report_step
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
from rlservo.robots.ros2.ros_messages import DIAGNOSTICS, POSE_STAMPED, stamp
from rlservo.robots.ur.parameters import JOINTS

HEARTBEAT_S = 0.5
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

# Arguments of a policy's environment that say what its elements mean, and which robot it is for.
MEANINGS = ("ur_model", "restrict_wrist_1", "action_cycle_rate", "max_velocity_scale_factor", *(
    f"fix_{joint}" for joint in JOINTS
))  # fmt: skip

NUMBER = re.compile(r"[\d.]+")  # an age, say: it differs in each cycle
log = logging.getLogger("rlservo.ros2")


def real_environment(contract: Contract) -> tuple[str, dict[str, Any]] | None:
    """Return the simulated environment of ours that a policy was trained in and its arguments; None for others."""
    config = contract.provenance.env_config
    name = str(config.get("env_id") or contract.provenance.env_id).rpartition("/")[2]
    return (name, {key: config[key] for key in MEANINGS if key in config}) if name in REAL else None


class Wanted(str, Enum):
    """The last request of the services."""

    RUN = "run"
    HOLD = "hold"
    STOP = "stop"


class PolicyNode:
    """A node `rlservo`, driven until `stop` is set. Its services answer at once, the loop follows."""

    def __init__(self, policy: ActingPolicy, name: str, *, autostart: bool) -> None:
        """Join the graph. Raises RobotError without rclpy."""
        self.policy = policy
        self.stop = threading.Event()
        self.on_connected: Callable[[], object] = lambda: None  # before, nothing looks at `stop`
        self.link = RclpyLink(name, is_unique=True)
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

    def parameters(self) -> dict[str, str]:
        """Return the parameters that map elements: `observation.NAME`, `action.NAME` and `stop.NAME`."""
        found: dict[str, str] = {}
        for side in ("observation", "action", "stop"):
            for name, parameter in self.link.node.get_parameters_by_prefix(side).items():
                found[f"{side}.{name}"] = str(parameter.value)
        return found

    def enter(self, state: str, why: str = "") -> None:
        """Change the state: a line in the log where more than a number of it is new, and the next heartbeat."""
        if (state, NUMBER.sub("", why)) != (self.state, NUMBER.sub("", self.why)):
            log.info("node: %s -> %s%s", self.state, state, f": {why}" if why else "")
        self.state, self.why = state, why

    def close(self) -> None:
        """Leave the graph."""
        self._is_closed.set()
        self._thread.join()
        self.link.close()

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
    observed, acted = places(contract, node.parameters())
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


class _Target:
    """The newest target, and the numbers of those that were begun and that are over."""

    def __init__(self, frame: str) -> None:
        self._frame = frame
        self.pose: Any = None
        self.number = self.begun = self.done = 0

    def take(self, message: Any) -> None:
        frame = message.header.frame_id
        if frame and frame != self._frame:
            log.warning("a target in frame %r was ignored: expected %r", frame, self._frame)
            return
        self.pose = message.pose.position
        self.number += 1


def drive_environment(node: PolicyNode, trained_in: str, arguments: Mapping[str, Any], *, unproven: bool) -> None:
    """Drive one of our robots to each target on `~/target` until the node is stopped. Raises UsageError, RobotError."""
    real_id, option, frame = REAL[trained_in]
    env = make_env(f"rlservo/{real_id}", arguments, render=False)
    try:
        node.on_connected()
        check_fit(node.policy.contract, env, arguments)
        if not unproven:
            check_proven(node.policy.contract, env)
        robot: Any = env.unwrapped
        target = _Target(robot.simulation.frame if frame == "odom" else frame)
        node.link.subscribe("~/target", POSE_STAMPED, target.take)
        for word, to_person in (("take_over", True), ("hand_back", False)):
            node.link.serve(f"~/{word}", partial(_lead, robot.simulation.operator, to_person=to_person))
        robot.simulation.states.on_change = partial(_say_hold, node)
        robot.simulation.is_called_off = lambda: node.stop.is_set() or node.wanted is not Wanted.RUN
        starts = node.starts
        while not node.stop.is_set():
            if node.state != "fault":
                starts = node.starts
            elif node.starts > starts:
                robot.simulation.operator.allow_restart()
                node.enter("waiting", "started again")
                robot.simulation.stopped_by = None
            else:
                if target.number != target.done:
                    log.warning("node: a target was ignored: the robot has stopped; call the start service first")
                target.done = target.number
                robot.simulation.advance()
                continue
            if node.wanted is not Wanted.RUN:
                node.enter("stopped" if node.wanted is Wanted.STOP else "holding", "asked for")
            elif robot.simulation.is_led:
                node.enter(robot.simulation.states.state.value)
            elif target.number == target.done:
                if robot.simulation.stopped_by is not None:  # while it stood
                    node.enter("fault", robot.simulation.stopped_by)
                elif node.state not in ("arrived", "failed", "refused"):
                    node.enter("waiting", f"no new target on {node.link.node.resolve_topic_name('~/target')}")
            else:
                _drive_to(node, env, option, target)
                continue
            robot.simulation.advance()  # the model stays where the robot is
    finally:
        env.close()


def _say_hold(node: PolicyNode, change: Change) -> None:
    """Tell the heartbeat of a robot that holds, while the step waits for it; the drive tells the other states."""
    if change.state == ControlState.HOLD.value and node.state in ("running", "blocked"):
        node.enter(change.state, change.why)


def _lead(operator: Operator, *, to_person: bool) -> tuple[bool, str]:
    """Answer a service: let a person lead the robot once it is at rest, or give it back to the policy."""
    if operator.has_taken_over != to_person:
        operator.toggle()
    return True, "the state is human once the robot may be led" if to_person else "given back"


def _drive_to(node: PolicyNode, env: Any, option: str, target: _Target) -> None:
    """Drive to the newest target, which remains due if the drive is interrupted.

    As in a rollout an arm first returns to its start: that is where its policy was trained and proven. After an
    interruption it goes on from its present pose.
    """
    robot, policy = env.unwrapped, node.policy
    number, position = target.number, target.pose
    goal = [position.x, position.y, position.z] if option == "ee_target_pose" else [position.x, position.y]
    if not np.isfinite(goal).all():  # an arm would return to its start before it is noticed
        node.enter("refused", f"the target is {', '.join(f'{value:g}' for value in goal)} m: expected finite numbers")
        target.done = number
        return
    goal += [0.0] * ((6 if option == "ee_target_pose" else 3) - len(goal))
    if target.begun != number:
        node.enter("starting")
    options = {**robot.reset_options(start="here" if target.begun == number else "own"), option: goal}
    try:
        observation, _ = env.reset(options=options)
    except ValueError as error:
        if not robot.simulation.is_called_off():
            node.enter("fault" if isinstance(error, RobotError) else "refused", str(error))
            target.done = number  # a robot must not move by itself: a new target is needed, after a fault a start too
        return
    target.begun = number
    policy.reset()
    is_first = True
    while not node.stop.is_set() and node.wanted is Wanted.RUN and target.number == number:
        try:
            action = policy.act(observation)
        except RlservoError as error:
            node.enter("holding", error.message)
            node.counts["late"] += 1
            robot.simulation.hold()
            robot.simulation.advance()
            return
        node.counts["episodes"] += is_first
        is_first = False
        step = env.step(action)
        report_step(policy, step)
        observation, _, terminated, truncated, info = step
        node.counts["decisions"] += 1
        state, blocked = info["robot"]["state"], info["robot"].get("blocked", "")
        if terminated or truncated:
            robot.simulation.hold()
            node.counts["successes"] += bool(info["is_success"])
            log.info("node: target %d: %s", number, info["final_status"])
            if robot.simulation.stopped_by is not None:
                causes = [change["why"] for change in info["robot"].get("changes", []) if change["state"] == "fault"]
                node.enter("fault", (causes or [info["final_status"]])[-1])
            elif info["is_success"]:
                node.enter("arrived", info["final_status"])
            else:
                node.enter("failed", info["final_status"] + (f", blocked: {blocked}" if blocked else ""))
            target.done = number
            return
        if state in ("run", "blend_in"):
            node.enter("blocked" if blocked else "running", blocked)
        else:
            node.enter(state)
    robot.simulation.hold()
