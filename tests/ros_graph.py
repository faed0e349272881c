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
from rclpy.executors import SingleThreadedExecutor
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

    def take(topic: str, message: Any) -> None:
        messages[topic].append((time.time(), message))
        del messages[topic][:-KEPT]

    def subscribe(topic: str, kind: str) -> None:
        qos = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
        node.create_subscription(interface(kind), topic, lambda message: take(topic, message), qos)

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

    def withdraw(topic: str) -> None:
        node.destroy_publisher(made.pop(topic))

    def since(topic: str, time_s: float, count: int = KEPT) -> Any:
        return [(at, to_plain(one)) for at, one in messages[topic][-count:] if at >= time_s]

    def publishers(topic: str) -> Any:
        return [one.node_name for one in node.get_publishers_info_by_topic(topic)]

    known = {
        "subscribe": subscribe, "publish": publish, "call": call, "since": since, "publishers": publishers,
        "withdraw": withdraw,
        "lead": lead, "arrived": lambda topic: arrived[topic],
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
