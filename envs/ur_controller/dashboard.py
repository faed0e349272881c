"""Dashboard server of the simulated controller: a line of text in, a line of text out.

Source of the commands and replies: Universal Robots, "Dashboard Server e-Series, port 29999".
"""

from __future__ import annotations

from rlservo.envs.ur_controller.controller import Controller, RobotMode, SafetyMode

GREETING = "Connected: Universal Robots Dashboard Server"
SAFETY_NAMES = {
    SafetyMode.NORMAL: "NORMAL",
    SafetyMode.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    SafetyMode.ROBOT_EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}
FIXED = {
    "get serial number": "20225500001",
    "get loaded program": "No program loaded",
    "isprogramsaved": "true <unnamed>",
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
    "restart safety": "Restarting safety",
    "play": "Failed to execute: play",
    "pause": "Failed to execute: pause",
    "quit": "Disconnected",
}


def answer(controller: Controller, line: str) -> str:
    """Carry out a command and return its reply."""
    command = line.strip().lower()
    if command in FIXED:
        return FIXED[command]
    if command == "polyscopeversion":
        return f"URSoftware {'.'.join(map(str, controller.version))} (simulated)"
    if command == "get robot model":
        return controller.ur_model.removesuffix("e").upper()
    if command == "is in remote control":
        return str(controller.is_remote).lower()
    if command == "robotmode":
        return f"Robotmode: {controller.robot_mode.name}"
    if command in ("safetymode", "safetystatus"):
        return f"{command.capitalize()}: {SAFETY_NAMES[controller.safety_mode]}"
    if command == "programstate":
        return f"{'PLAYING' if controller.is_program_running else 'STOPPED'} <unnamed>"
    if command == "running":
        return f"Program running: {str(controller.is_program_running).lower()}"
    return _change(controller, command, line)


def _change(controller: Controller, command: str, line: str) -> str:
    if command == "stop":
        controller.stop_program("the dashboard stopped it")
        return "Stopped"
    if command == "unlock protective stop":
        if controller.unlock_protective_stop():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )
    if command == "power off":
        controller.stop_program("power off")
        controller.robot_mode = RobotMode.POWER_OFF
        return "Powering off"
    is_safe = controller.safety_mode == SafetyMode.NORMAL
    if command == "power on":
        if is_safe and controller.robot_mode == RobotMode.POWER_OFF:
            controller.robot_mode = RobotMode.IDLE
        return "Powering on"
    if command == "brake release":
        if is_safe:
            controller.robot_mode = RobotMode.RUNNING
        return "Brake releasing"
    if command.startswith("popup "):
        return "showing popup"
    if command.startswith("addtolog "):
        return "Added log message"
    return f'could not understand: "{line.strip()[:100]}"'
