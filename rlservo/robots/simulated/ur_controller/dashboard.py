"""Dashboard server of the simulated controller: a line of text in, a line of text out.

Source of the commands and replies: Universal Robots, "Dashboard Server e-Series, port 29999".
"""

from __future__ import annotations

import logging

from rlservo.robots.simulated.ur_controller.controller import Controller, RobotMode, SafetyMode

GREETING = "Connected: Universal Robots Dashboard Server"
GOODBYE = "Disconnected"
SAFETY_NAMES = {
    SafetyMode.NORMAL: "NORMAL",
    SafetyMode.PROTECTIVE_STOP: "PROTECTIVE_STOP",
    SafetyMode.ROBOT_EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP",
}
FIXED = {
    "get serial number": "20225500001",
    "get loaded program": "No program loaded",
    "get operational mode": "NONE",  # no password is set for it
    "isprogramsaved": "true <unnamed>",
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
    "restart safety": "Restarting safety",
    "quit": GOODBYE,
}

SHOWN = {"popup": "showing popup", "addtolog": "Added log message"}  # in our log

log = logging.getLogger("rlservo.ur_controller")


def answer(controller: Controller, line: str) -> str:
    """Carry out a command and return its reply."""
    command = line.strip().lower()
    if command in FIXED:
        return FIXED[command]
    if command == "version":
        return ".".join(map(str, controller.version))
    if command == "polyscopeversion":
        return f"URSoftware {'.'.join(map(str, controller.version))} (simulated)"
    if command == "get robot model":
        return {"ur7e": "UR5", "ur12e": "UR10"}.get(controller.ur_model, controller.ur_model.removesuffix("e").upper())
    if command == "is in remote control":
        return str(controller.is_remote).lower()
    if command == "robotmode":
        return f"Robotmode: {controller.robot_mode.name}"
    if command in ("safetymode", "safetystatus"):
        return f"{command.capitalize()}: {SAFETY_NAMES[controller.safety_mode]}"
    if command == "programstate":
        state = "PAUSED" if controller.is_paused else "PLAYING" if controller.is_program_running else "STOPPED"
        return f"{state} <unnamed>"
    if command == "running":
        return f"Program running: {str(controller.is_program_running and not controller.is_paused).lower()}"
    return _change(controller, command, line)


def _change(controller: Controller, command: str, line: str) -> str:
    if command == "stop":
        controller.stop_program("the dashboard stopped it")
        return "Stopped"
    if command == "pause":
        return "Pausing program" if controller.pause_program() else "Failed to execute: pause"
    if command == "play":
        return "Starting program" if controller.resume_program() else "Failed to execute: play"
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
    word, _, text = line.strip().partition(" ")
    if word.lower() == "load" and text:  # there are no files
        return f"File not found: {text.removeprefix('installation ')}"
    if word.lower() in SHOWN and text:
        log.info("%s: %s", word, text)
        return SHOWN[word.lower()]
    return f'could not understand: "{line.strip()[:100]}"'
