"""The command's options as parameters of its node."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from rlservo.errors import UsageError
from rlservo.robots.ros2.rclpy_link import RclpyLink

KINDS = {bool: "BOOL", float: "DOUBLE", list[str]: "STRING_ARRAY"}  # others are strings
ROS_OWN = ("use_sim_time", "start_type_description_service", "qos_overrides.")  # of every node
MAPPED = ("observation.", "action.", "stop.")


def with_parameters(link: RclpyLink, command: Callable[..., Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options, with a parameter's value for each that was not given. All become read-only parameters.

    Raises UsageError for a parameter that is unknown, RobotError for one of another type.
    """
    names = [name for name in link.parameters() if not name.startswith((*ROS_OWN, *MAPPED))]
    if unknown := [name for name in names if name not in given]:
        raise UsageError(f"parameter {unknown[0]!r} is unknown: expected one of {', '.join((*given, *MAPPED))}...")
    hints, signature = get_type_hints(command, include_extras=True), inspect.signature(command).parameters
    chosen = {}
    for name, value in given.items():
        kind, option = get_args(hints[name])
        plain = next(one for one in (*get_args(kind), kind) if one is not type(None)) if _is_optional(kind) else kind
        found = link.declare(
            name, KINDS.get(plain, "STRING"), option.help, low=option.min,
            value=str(value) if isinstance(value, Path) else value, is_fixed=value != signature[name].default,
        )  # fmt: skip
        if get_origin(plain) is Literal and found not in (None, *get_args(plain)):
            raise UsageError(f"parameter {name!r} is {found!r}: expected {' or '.join(get_args(plain))}")
        chosen[name] = Path(found) if plain is Path and found is not None else found
    for name in link.parameters():
        if name.startswith(MAPPED):
            link.declare(name, "", "Message field of an element, or the number that stops it.")
    return chosen


def _is_optional(kind: Any) -> bool:
    return type(None) in get_args(kind)
