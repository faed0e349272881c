"""Link through the machine's own rclpy: a node, and a thread that takes its messages."""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, Literal

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.ros2.link import FIRST_MESSAGES_S, Endpoint, Publish, safely, wait_until

GUARD = "rlservo_guard"  # publishes only zeros, when its own commander has fallen silent
SERVICE_S = 3.0  # for a service to be discovered, and to answer
KEPT_MESSAGES = 100  # each node of a graph keeps its own static transforms
ARGUMENTS_VARIABLE = "RLSERVO_ROS_ARGS"  # remappings and parameters, also for the processes that we start
MOST = 1e9  # a parameter's range has two ends
RATE_S, RATE_ERROR = 5.0, 0.1  # [s] over which simulated time is compared with the wall clock's, and their difference

log = logging.getLogger("rlservo.robot")

Outcome = Literal["succeed", "abort", "canceled"]


class Goal:
    """A goal of an action, which is active until `end`. Any thread may call its methods."""

    def __init__(self, handle: Any, action: Any, wake: Callable[[], None]) -> None:
        """Made by `RclpyLink.serve_action`, for rclpy's own handle."""
        self.request: Any = handle.request
        self._handle, self._action, self._wake = handle, action, wake
        self._is_first = threading.Lock()  # held by the first `end`
        self._outcome: tuple[Outcome, Mapping[str, Any]] | None = None
        self.is_over = threading.Event()  # whether the client gets to know of the end

    @property
    def is_cancelled(self) -> bool:
        """Whether a client has asked for its end."""
        return bool(self._handle.is_cancel_requested)

    def tell(self, feedback: Mapping[str, Any]) -> None:
        """Publish feedback."""
        self._handle.publish_feedback(fill(self._action.Feedback(), feedback))

    def end(self, outcome: Outcome, result: Mapping[str, Any]) -> None:
        """End it, once; fields that the distribution's result lacks are left out. "canceled" needs `is_cancelled`."""
        if self._is_first.acquire(blocking=False):
            self._outcome = outcome, result
            self._wake()

    def __await__(self) -> Generator[None, None, Any]:
        """Wait in the executor's thread until the end, and return the result."""
        while self._outcome is None:
            yield
        outcome, values = self._outcome
        self.is_over.set()
        {"succeed": self._handle.succeed, "abort": self._handle.abort, "canceled": self._handle.canceled}[outcome]()
        result = self._action.Result()
        return fill(result, {name: value for name, value in values.items() if hasattr(result, name)})


class RosLog(logging.Handler):
    """Passes our log to ROS's, which has the terminal, /rosout and a file."""

    def __init__(self, logger: Any) -> None:
        """Take a node's logger."""
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record. rclpy wants each line of code to have one severity."""
        if record.levelno >= logging.ERROR:
            self._logger.error(record.getMessage())
        elif record.levelno >= logging.WARNING:
            self._logger.warning(record.getMessage())
        else:
            self._logger.info(record.getMessage())


class RclpyLink:
    """A ROS 2 node with a unique name: two with one name could not be told apart."""

    knows_quality = True

    def __init__(self, name: str, *, is_unique: bool = False) -> None:
        """Join the graph. `is_unique`: the name is used as it is, else with our process id. Raises RobotError."""
        try:
            import rclpy  # pyright: ignore[reportMissingImports]
            from rclpy import executors  # pyright: ignore[reportMissingImports]
            from rclpy.signals import SignalHandlerOptions  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise RobotError(
                f"ROS 2's rclpy cannot be imported ({error}): source /opt/ros/DISTRIBUTION/setup.bash, and use the "
                "Python that this ROS 2 is built for"
            ) from error
        self._context = rclpy.Context()
        arguments = [one for one in os.environ.get(ARGUMENTS_VARIABLE, "").split("\n") if one]
        given = ["--ros-args", *(arguments if is_unique else _without_names(arguments))] if arguments else None
        try:
            rclpy.init(args=given, context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self.node: Any = rclpy.create_node(
                name if is_unique else f"{name}_{os.getpid()}", context=self._context,
                automatically_declare_parameters_from_overrides=is_unique,
            )  # fmt: skip
        except Exception as error:  # rcl's own errors share no public base
            words = " ".join([name, *arguments])
            why = " ".join(str(error).split())  # it may point at the place, on a line of its own
            raise RobotError(f"ROS 2 does not accept the node's name or arguments, {words}: {why}") from error
        self._own: Counter[tuple[str, str]] = Counter()  # endpoints of ours, by topic
        self._has_simulated_time = bool(self.node.get_parameter("use_sim_time").value)
        self._clock_began = time.monotonic(), 0.0  # and ROS's time then [s]
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

        def spin() -> None:
            try:
                self._executor.spin()
            except Exception:
                if self._context.ok():  # else it ended: rclpy has no common base for what that raises
                    raise

        self._thread = threading.Thread(target=spin, name="ros", daemon=True)
        self._thread.start()
        wait_until(lambda: self.now_s() > 0.0, "no message on /clock, which use_sim_time asks for", FIRST_MESSAGES_S)

    def now_s(self) -> float:
        """Return ROS's time [s]: the system's, or /clock's with use_sim_time."""
        now_s = float(self.node.get_clock().now().nanoseconds * 1e-9)
        began, began_s = self._clock_began
        if self._has_simulated_time and (passed_s := time.monotonic() - began) > RATE_S:
            self._clock_began, rate = (time.monotonic(), now_s), (now_s - began_s) / passed_s
            if abs(rate - 1.0) > RATE_ERROR and began_s > 0.0:
                self._has_simulated_time = False  # said once
                log.warning(
                    "simulated time passes at %.2g times the wall clock's rate: the policy acts, and the limits hold, "
                    "by the wall clock",
                    rate,
                )
        return now_s

    def subscribe(self, topic: str, kind: str, on_message: Callable[[Any], None], *, is_kept: bool = False) -> None:
        """Subscribe to the newest message, best effort as for sensors; also to an earlier one if publishers keep it.

        `is_kept`: to all that publishers keep, also those of publishers that are not discovered yet.
        """
        from rclpy.qos import QoSDurabilityPolicy  # pyright: ignore[reportMissingImports]

        offered = {one.qos_profile.durability for one in self.node.get_publishers_info_by_topic(topic)}
        keeps = is_kept or offered == {QoSDurabilityPolicy.TRANSIENT_LOCAL}
        qos = self._qos(is_kept=keeps, is_reliable=False, depth=KEPT_MESSAGES if is_kept else 1)
        with self._overridable(topic) as options:
            made = self.node.create_subscription(
                message_class(kind), topic, safely(on_message, topic), qos, qos_overriding_options=options
            )
        self._own["subscriber", made.topic_name] += 1

    def advertise(self, topic: str, kind: str, *, is_kept: bool = False) -> Publish:
        """Publish reliably, only the newest message."""
        made = message_class(kind)
        qos = self._qos(is_kept=is_kept, is_reliable=True)
        with self._overridable(topic) as options:
            publisher = self.node.create_publisher(made, topic, qos, qos_overriding_options=options)
        self._own["publisher", publisher.topic_name] += 1

        def publish(values: Mapping[str, Any]) -> None:
            if self._context.ok():
                publisher.publish(fill(made(), values))

        return publish

    def serve(self, name: str, answer: Callable[[], tuple[bool, str]]) -> None:
        """Offer a std_srvs/Trigger service."""

        def handle(_request: Any, response: Any) -> Any:
            response.success, response.message = answer()
            return response

        self.node.create_service(message_class("std_srvs/srv/Trigger"), name, handle)

    def serve_action(self, name: str, kind: str, refusal: Callable[[Any], str], begin: Callable[[Goal], None]) -> None:
        """Offer an action. `refusal` returns why a goal is rejected, empty if it is accepted; `begin` must not block.

        Raises RobotError if the action's package is not installed.
        """
        from rclpy import action  # pyright: ignore[reportMissingImports]

        made = message_class(kind)

        def decide(request: Any) -> Any:
            if why := refusal(request):
                self.node.get_logger().warning(f"a goal of {name} is rejected: {why}")
            return action.GoalResponse.REJECT if why else action.GoalResponse.ACCEPT

        async def execute(handle: Any) -> Any:
            goal = Goal(handle, made, self._executor.wake)
            begin(goal)
            return await goal

        action.ActionServer(
            self.node, made, name, execute,
            goal_callback=decide, cancel_callback=lambda _: action.CancelResponse.ACCEPT,
        )  # fmt: skip

    @contextlib.contextmanager
    def has_log(self, name: str) -> Iterator[None]:
        """Pass a logger of Python's to ROS's log instead of the terminal, which that one has."""
        log, handler = logging.getLogger(name), RosLog(self.node.get_logger())
        log.addHandler(handler)
        log.propagate = False
        try:
            yield
        finally:
            log.propagate = True
            log.removeHandler(handler)

    def parameters(self) -> dict[str, Any]:
        """Return the values of all parameters that were given or declared."""
        return {name: one.value for name, one in self.node.get_parameters_by_prefix("").items()}

    def declare(
        self, name: str, kind: str, description: str, *, low: float | None = None, value: Any = None,
        is_fixed: bool = False,
    ) -> Any:  # fmt: skip
        """Declare a read-only parameter, and return what was given, else `value`.

        `kind` is such as DOUBLE, or empty for any; `is_fixed`: `value` counts, whatever was given. Raises RobotError
        for a value of another kind, or below `low`.
        """
        descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")(
            description=description,
            read_only=True,
            dynamic_typing=True,  # other types may not have no value
        )
        if low is not None:
            bounds = message_class("rcl_interfaces/msg/FloatingPointRange")(from_value=low, to_value=MOST)
            descriptor.floating_point_range = [bounds]
        given = self.parameters().get(name)
        if given is not None:  # declared as it came, which would let it change
            self.node.undeclare_parameter(name)
        expected = kind.lower().replace("_", " ") + ("" if low is None else f" of at least {low:g}")
        problem = f"parameter {name!r} is {value if is_fixed else given!r}: expected {expected}"
        try:
            found = self.node.declare_parameter(name, value, descriptor, ignore_override=is_fixed)
        except Exception as error:  # out of its range
            raise RobotError(problem) from error
        if kind not in ("", found.type_.name) and found.value is not None:
            raise RobotError(problem)
        return found.value

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of other nodes."""
        return self._others("publisher", topic, self.node.get_publishers_info_by_topic(topic))

    def rivals(self, topic: str, since_s: float = 0.0) -> list[Endpoint]:
        """Return the publishers of other nodes, as a robot obeys one; a guard does not count."""
        del since_s  # they are known before their first message
        return [one for one in self.publishers(topic) if not one.node.rpartition("/")[2].startswith(GUARD)]

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the subscribers of other nodes."""
        return self._others("subscriber", topic, self.node.get_subscriptions_info_by_topic(topic))

    def strings(self, node: str, parameter: str) -> list[str] | None:
        """Return a parameter of another node that is a list of strings; None if it cannot be read."""
        kind = message_class("rcl_interfaces/srv/GetParameters")
        client = self.node.create_client(kind, f"{node}/get_parameters")
        try:
            if not client.wait_for_service(timeout_sec=SERVICE_S):
                return None
            answered = threading.Event()
            reply = client.call_async(kind.Request(names=[parameter]))
            reply.add_done_callback(lambda _: answered.set())
            values = reply.result().values if answered.wait(SERVICE_S) else []
            return [*values[0].string_array_value] or None if values else None
        finally:
            self.node.destroy_client(client)

    def close(self) -> None:
        """Leave the graph and end the thread."""
        self._executor.shutdown(timeout_sec=1.0)
        self._context.try_shutdown()
        self._thread.join(2.0)
        self.node.destroy_node()

    def _others(self, which: str, topic: str, infos: Sequence[Any]) -> list[Endpoint]:
        own, others = self.node.get_fully_qualified_name(), []
        offers = [one.qos_profile for one in self.node.get_publishers_info_by_topic(topic) if _name_of(one) == own]
        mismatches = [_mismatch(offers[0], one) if which == "subscriber" and offers else "" for one in infos]
        found = [Endpoint(_name_of(one), one.topic_type, why) for one, why in zip(infos, mismatches, strict=True)]
        mine = self._own[which, self.node.resolve_topic_name(topic)]
        for one in found:  # another node may have our name
            if one.node == own and mine:
                mine -= 1
            else:
                others.append(one)
        return others

    @contextlib.contextmanager
    def _overridable(self, topic: str) -> Iterator[Any]:
        """Let parameters override the quality of service. Raises RobotError for a value that is none."""
        from rclpy.qos import QoSPolicyKind  # pyright: ignore[reportMissingImports]
        from rclpy.qos_overriding_options import QoSOverridingOptions  # pyright: ignore[reportMissingImports]

        kinds = [QoSPolicyKind[name] for name in ("HISTORY", "DEPTH", "RELIABILITY", "DURABILITY")]
        try:
            yield QoSOverridingOptions(kinds)
        except Exception as error:  # rclpy has no common base for what a wrong value raises
            prefix = f"qos_overrides.{self.node.resolve_topic_name(topic)}."
            given = {name: value for name, value in self.parameters().items() if name.startswith(prefix)}
            if not given:
                raise
            raise RobotError(f"{topic} does not accept the quality of service {given}: {error}") from error

    @staticmethod
    def _qos(*, is_kept: bool, is_reliable: bool, depth: int = 1) -> Any:
        from rclpy import qos  # pyright: ignore[reportMissingImports]

        reliable, best = qos.QoSReliabilityPolicy.RELIABLE, qos.QoSReliabilityPolicy.BEST_EFFORT
        durability = qos.QoSDurabilityPolicy.TRANSIENT_LOCAL if is_kept else qos.QoSDurabilityPolicy.VOLATILE
        return qos.QoSProfile(
            depth=depth, reliability=reliable if is_reliable or is_kept else best, durability=durability
        )


@functools.cache
def message_class(kind: str) -> Any:
    """Return the class of 'sensor_msgs/msg/JointState'. Raises RobotError if its package is not installed."""
    package, _, rest = kind.partition("/")
    folder, _, name = rest.rpartition("/")
    try:
        return getattr(importlib.import_module(f"{package}.{folder or 'msg'}"), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise RobotError(f"the ROS 2 interface {kind!r} is not installed here: {error}") from error


def message_fields(kind: str) -> Mapping[str, str]:
    """Return the types of a message's fields, by name; `kind` is 'geometry_msgs/Twist', as those types are written."""
    fields: Mapping[str, str] = message_class(kind.replace("/", "/msg/")).get_fields_and_field_types()
    return fields


def fill(message: Any, values: Mapping[str, Any]) -> Any:
    """Set the fields of a message from a dictionary, and return it."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            fill(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            kind = message.get_fields_and_field_types()[name].removeprefix("sequence<").partition(">")[0]
            made = message_class(kind.replace("/", "/msg/"))
            setattr(message, name, [fill(made(), one) for one in value])
        else:
            setattr(message, name, value)
    return message


def _name_of(info: Any) -> str:
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _mismatch(offer: Any, subscriber: Any) -> str:
    """Return why an offered quality of service does not reach a subscriber; empty if it does."""
    from rclpy.qos import QoSCompatibility, qos_check_compatible  # pyright: ignore[reportMissingImports]

    fit, why = qos_check_compatible(offer, subscriber.qos_profile)
    return str(why).removeprefix("ERROR: ").strip("; ") if fit == QoSCompatibility.ERROR else ""


def _without_names(arguments: Sequence[str]) -> list[str]:
    """Return ROS arguments without those that would give all our nodes the same name."""
    kept = list(arguments)
    for index in reversed(range(len(kept))):
        if kept[index].startswith(("__node:=", "__name:=")):
            del kept[max(index - 1, 0) : index + 1]
    return kept
