"""Another node of the graph, in a process with the real rclpy: it answers each line of JSON with another.

Run by `ros.Graph`; it imports nothing from rlservo, so names and types are written twice.
"""

from __future__ import annotations

import importlib
import json
import math
import sys
import threading
import time
from collections import defaultdict
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

KEPT = 5000  # messages of a topic


def interface(kind: str) -> Any:
    module, _, name = kind.replace("/", ".").rpartition(".")
    return getattr(importlib.import_module(module), name)


def to_plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, str | int | float | bool):
        return value
    return [to_plain(one) for one in value]


def fill(message: Any, values: dict[str, Any]) -> Any:
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("bystander")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    messages: dict[str, list[tuple[float, Any]]] = defaultdict(list)
    made: dict[str, Any] = {}
    arrived: dict[str, int] = {}
    goals: list[dict[str, Any]] = []
    clients: dict[str, Any] = {}

    def take(topic: str, message: Any) -> None:
        messages[topic].append((time.time(), message))
        del messages[topic][:-KEPT]

    def subscribe(topic: str, kind: str, is_kept: bool = False) -> None:
        """Take messages; `is_kept`: only of publishers that keep them for late comers."""
        qos = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
        if is_kept:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        silent = SubscriptionEventCallbacks(use_default_callbacks=False)  # which warn in the midst of our JSON
        node.create_subscription(
            interface(kind), topic, lambda message: take(topic, message), qos, event_callbacks=silent
        )

    def publish(topic: str, kind: str, values: dict[str, Any], is_stamped: bool = True, age_s: float = 0.0) -> None:
        if topic not in made:
            made[topic] = node.create_publisher(interface(kind), topic, 1)
            wait_for_subscriber(topic)
        message = fill(interface(kind)(), values)
        if is_stamped and hasattr(message, "header"):
            made_s = time.time() - age_s
            message.header.stamp.sec, message.header.stamp.nanosec = int(made_s), int(made_s % 1 * 1e9)
        made[topic].publish(message)

    def lead(topic: str, targets: list[tuple[float, float]]) -> None:
        """Publish distance and direction of one target after the other [m], [rad], as seen from a base on /odom."""
        made[topic] = node.create_publisher(interface("std_msgs/msg/Float64MultiArray"), topic, 1)
        arrived[topic] = 0

        def look(odometry: Any) -> None:
            place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
            x, y = targets[min(arrived[topic], len(targets) - 1)]
            distance = math.hypot(x - place.x, y - place.y)
            direction = math.atan2(y - place.y, x - place.x) - 2.0 * math.atan2(turn.z, turn.w)
            arrived[topic] += distance < 0.2
            seen = [distance, math.remainder(direction, 2.0 * math.pi)]
            made[topic].publish(fill(made[topic].msg_type(), {"data": seen}))

        node.create_subscription(interface("nav_msgs/msg/Odometry"), "/odom", look, 1)

    def wait_for_subscriber(topic: str) -> None:
        limit = time.monotonic() + 60.0
        while not node.count_subscribers(topic):
            assert time.monotonic() < limit, f"nothing subscribes to {topic}"
            time.sleep(0.05)
        time.sleep(0.5)  # until it has discovered us too

    def call(service: str) -> Any:
        kind = interface("std_srvs/srv/Trigger")
        client = node.create_client(kind, service)
        assert client.wait_for_service(60.0), f"no service {service}"
        sent_s, future = time.time(), client.call_async(kind.Request())
        limit = time.monotonic() + 60.0
        while not future.done():
            assert time.monotonic() < limit, f"service {service} does not answer"
            time.sleep(0.01)
        return {"sent_s": sent_s, **to_plain(future.result())}

    def wait_for(future: Any, what: str) -> Any:
        limit = time.monotonic() + 60.0
        while not future.done():
            assert time.monotonic() < limit, f"{what} does not answer"
            time.sleep(0.01)
        return future.result()

    def send_goal(action: str, kind: str, values: dict[str, Any]) -> int | None:
        """Send a goal and return its number, None if it is rejected."""
        made = interface(kind)
        if action not in clients:
            clients[action] = ActionClient(node, made, action)
        assert clients[action].wait_for_server(60.0), f"no action {action}"
        time.sleep(0.5)  # until the server has discovered us too: an answer before that is lost
        goal: dict[str, Any] = {"feedback": [], "ended_s": None}
        sent = clients[action].send_goal_async(
            fill(made.Goal(), values), lambda message: goal["feedback"].append((time.time(), message.feedback))
        )
        goal["handle"] = wait_for(sent, action)
        if not goal["handle"].accepted:
            return None
        goal["result"] = goal["handle"].get_result_async()
        goal["result"].add_done_callback(lambda _: goal.update(ended_s=time.time()))
        goals.append(goal)
        return len(goals) - 1

    def goal(number: int) -> Any:
        """Return a goal's status, and its result once it has one."""
        one = goals[number]
        known = {"status": one["handle"].status, "ended_s": one["ended_s"], "count": len(one["feedback"])}
        if one["result"].done():
            known |= {"status": one["result"].result().status, "result": to_plain(one["result"].result().result)}
        return known | {"feedback": to_plain(one["feedback"][-1][1]) if one["feedback"] else None}

    def cancel(number: int) -> Any:
        """Ask for a goal's end; return when, and how many goals will end."""
        sent_s = time.time()
        answer = wait_for(goals[number]["handle"].cancel_goal_async(), "cancel")
        return {"sent_s": sent_s, "count": len(answer.goals_canceling)}

    def request(of: str, what: str, **fields: Any) -> Any:
        """Call a parameter service of a node."""
        kind = interface(f"rcl_interfaces/srv/{what}Parameters")
        client = node.create_client(kind, f"{of}/{what.lower()}_parameters")
        assert client.wait_for_service(60.0)
        return to_plain(wait_for(client.call_async(kind.Request(**fields)), of))

    def parameter(of: str, which: str) -> Any:
        """Return a parameter's value and descriptor."""
        value, descriptor = request(of, "Get", names=[which]), request(of, "Describe", names=[which])
        return {**value["values"][0], **descriptor["descriptors"][0]}

    def set_parameter(of: str, which: str, value: Any) -> Any:
        return request(of, "Set", parameters=[Parameter(which, value=value).to_parameter_msg()])["results"][0]

    def offered(topic: str, what: str) -> Any:
        """Return the quality of service of a topic's publishers or subscriptions."""
        found = getattr(node, f"get_{what}_info_by_topic")(topic)
        return [(one.node_name, one.qos_profile.reliability.name) for one in found]

    def send_frames(topic: str, parent: str, frames: dict[str, tuple[float, float, float]]) -> None:
        """Publish static frames as x, y [m] and yaw [rad] in their parent, from a publisher of their own."""
        message = interface("tf2_msgs/msg/TFMessage")()
        for name, (x, y, yaw) in frames.items():
            one = interface("geometry_msgs/msg/TransformStamped")()
            one.header.frame_id, one.child_frame_id = parent, name
            one.transform.translation.x, one.transform.translation.y = x, y
            one.transform.rotation.z, one.transform.rotation.w = math.sin(yaw / 2.0), math.cos(yaw / 2.0)
            message.transforms.append(one)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        made[f"{topic} {parent}"] = node.create_publisher(type(message), topic, kept)
        made[f"{topic} {parent}"].publish(message)

    def run_clock(rate: float) -> None:
        """Publish a simulation's time on /clock, which passes at `rate` times the wall clock's."""
        publisher, began_s = node.create_publisher(interface("rosgraph_msgs/msg/Clock"), "/clock", 1), time.monotonic()

        def tick() -> None:
            now_s, message = 100.0 + rate * (time.monotonic() - began_s), interface("rosgraph_msgs/msg/Clock")()
            message.clock.sec, message.clock.nanosec = int(now_s), int(now_s % 1 * 1e9)
            publisher.publish(message)

        node.create_timer(0.02, tick)

    def withdraw(topic: str) -> None:
        node.destroy_publisher(made.pop(topic))

    def since(topic: str, time_s: float, count: int = KEPT) -> Any:
        return [(at, to_plain(one)) for at, one in messages[topic][-count:] if at >= time_s]

    def publishers(topic: str) -> Any:
        return [one.node_name for one in node.get_publishers_info_by_topic(topic)]

    known = {
        "subscribe": subscribe, "publish": publish, "call": call, "since": since, "publishers": publishers,
        "withdraw": withdraw, "send_frames": send_frames, "send_goal": send_goal, "goal": goal, "cancel": cancel,
        "parameter": parameter, "set_parameter": set_parameter, "offered": offered,
        "lead": lead, "run_clock": run_clock, "arrived": lambda topic: arrived[topic],
    }  # fmt: skip
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        name, arguments = json.loads(line)
        try:
            answer = {"value": known[name](**arguments)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
