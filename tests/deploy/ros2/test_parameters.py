"""The command's options as parameters of the node, overrides of the quality of service, and what is refused."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from bundles import write_box_policy
from rlservo.deploy.commands.ros2 import ros2
from ros import Process, Ros

COMMANDS = "/forward_command_controller/commands"
REFUSED = {
    "-p max_ages:=0.1": "parameter 'max_ages' is unknown: expected one of bundle, version",
    "-p max_age:=soon": "parameter 'max_age' is 'soon': expected double of at least 0.01",
    "-p rate:=0.01": "parameter 'rate' is 0.01: expected double of at least 0.1",
    "-p rate:=20": "parameter 'rate' is 20: expected double of at least 0.1",
    "-p transport:=tcp": "parameter 'transport' is 'tcp': expected http or ws",
    "-p autostart:=5": "parameter 'autostart' is 5: expected bool",
    "-p qos_overrides./diagnostics.publisher.reliability:=perhaps": "/diagnostics does not accept the quality of",
    "-p stop.joint_0:=[1.0,2.0]": "parameter 'stop.joint_0' is",
}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box_policy(tmp_path_factory.mktemp("described"))


@pytest.fixture(scope="module")
def node(ros: Ros, bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Process:
    """A node that has everything from a parameter file, but for one option."""
    path = tmp_path_factory.mktemp("parameters") / "node.yaml"
    path.write_text(
        f"""/rlservo:
  ros__parameters:
    bundle: {bundle}
    rate: 5.0
    max_age: 0.7
    autostart: true
    qos_overrides:
      {COMMANDS}: {{publisher: {{reliability: best_effort, depth: 3}}}}
"""
    )
    ros.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")
    ros.ask("subscribe", topic=COMMANDS, kind="std_msgs/msg/Float64MultiArray")
    words = ("--max-age", 0.9, "--ros-args", "--params-file", path, "-r", f"~/action:={COMMANDS}")
    node = ros.rlservo("ros2", *words)
    ros.wait_until(lambda: ros.heartbeat()["state"] == "waiting")  # autostart
    return node


def test_options_are_described_read_only_parameters_and_the_option_wins(ros: Ros, node: Process) -> None:
    rate = ros.ask("parameter", of="/rlservo", which="rate")
    assert rate["double_value"] == 5.0
    assert rate["description"].startswith("Mapped elements: control rate [Hz]")
    assert rate["floating_point_range"][0]["from_value"] == 0.1
    assert "read-only" in ros.ask("set_parameter", of="/rlservo", which="rate", value=9.0)["reason"]
    assert ros.ask("parameter", of="/rlservo", which="max_age")["double_value"] == 0.9
    assert ros.ask("parameter", of="/rlservo", which="robot")["string_value"] == "ros2:"
    for name in inspect.signature(ros2).parameters:
        if name not in ("name", "mapping", "ros_args"):
            found = ros.ask("parameter", of="/rlservo", which=name)
            assert found["description"] and found["read_only"], name


def test_parameters_override_the_quality_of_service(ros: Ros, node: Process) -> None:
    ros.wait_until(lambda: ["rlservo", "BEST_EFFORT"] in ros.ask("offered", topic=COMMANDS, what="publishers"))
    ros.wait_until(lambda: ["rlservo", "RELIABLE"] in ros.ask("offered", topic="/diagnostics", what="publishers"))
    for policy, kind, value in (("depth", "integer_value", 3), ("durability", "string_value", "volatile")):
        found = ros.ask("parameter", of="/rlservo", which=f"qos_overrides.{COMMANDS}.publisher.{policy}")
        assert found[kind] == value


def test_parameter_that_is_unknown_or_of_another_type_is_refused_in_one_sentence(ros: Ros, bundle: Path) -> None:
    started = {
        words: ros.rlservo("ros2", "--bundle", bundle, "--name", f"wrong_{index}", "--ros-args", *words.split())
        for index, words in enumerate(REFUSED)
    }
    for words, process in started.items():
        assert process.end(0) == 2, process.lines
        assert REFUSED[words] in " ".join(process.lines), process.lines
        assert not any("Traceback" in line for line in process.lines), "\n".join(process.lines)


def test_commands_that_their_subscriber_cannot_get_are_refused(ros: Ros, bundle: Path) -> None:
    topic = "/kept_controller/commands"
    ros.ask("subscribe", topic=topic, kind="std_msgs/msg/Float64MultiArray", is_kept=True)
    words = ("ros2", "--bundle", bundle, "--autostart", "--ros-args", "-r", f"~/action:={topic}", "-r")
    node = ros.rlservo(*words, "__node:=unheard")
    why = node.wait_for("the quality of service keeps our commands from")
    assert "/bystander (Volatile publisher and transient local subscription): change its own, or ours" in why
    assert f"(-p qos_overrides.{topic}.publisher" in why
    assert node.end(0) == 2
    ros.ask("subscribe", topic="/diagnostics", kind="diagnostic_msgs/msg/DiagnosticArray")
    heard = ros.rlservo(*words, "__node:=heard", "-p", f"qos_overrides.{topic}.publisher.durability:=transient_local")
    ros.wait_until(lambda: ros.heartbeat("heard")["state"] == "waiting")
    heard.end()


def test_simulated_time_at_another_rate_than_the_policys_is_named(ros: Ros, bundle: Path) -> None:
    """Gazebo at half speed: ten actions a second are then twenty a simulated second."""
    topic = "/simulated_controller/commands"
    ros.ask("subscribe", topic=topic, kind="std_msgs/msg/Float64MultiArray")
    ros.ask("run_clock", rate=0.5)
    words = ("ros2", "--bundle", bundle, "--ros-args", "-r", f"~/action:={topic}", "-p", "use_sim_time:=true")
    node = ros.rlservo(*words, "-r", "__node:=simulated")
    node.wait_for("simulated time passes at 0.5 times the wall clock's rate: the policy acts, and the limits hold, by")
    node.end()
