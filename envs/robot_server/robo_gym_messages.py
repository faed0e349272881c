"""robo-gym's protobuf messages.

Source of names and numbers: jr-robotics/robo-gym-server-modules, robot_server.proto and server_manager.proto.
"""

from __future__ import annotations

from typing import Any

from rlservo.protobuf_messages import build_messages

ROBOT_SERVER = "robot_server.RobotServer"
SERVER_MANAGER = "robo_gym_server_manager.grpc_msgs.server_manager.ServerManager"

_ROBOT_SERVER = build_messages(
    ROBOT_SERVER.rpartition(".")[0],
    {
        "Success": ["bool success"],
        "Empty": [],
        "Action": ["repeated float action", "bool success"],
        "State": [
            "repeated float state",
            "map float float_params",
            "map string string_params",
            "map float state_dict",
            "bool success",
        ],
    },
)
_SERVER_MANAGER = build_messages(
    SERVER_MANAGER.rpartition(".")[0],
    {
        "RobotServer": ["string cmd", "bool gui", "int32 port", "bool success", "string info"],
        "Status": ["bool alive"],
        "Empty": [],
    },
)

Success: Any = _ROBOT_SERVER["Success"]
Empty: Any = _ROBOT_SERVER["Empty"]
Action: Any = _ROBOT_SERVER["Action"]
State: Any = _ROBOT_SERVER["State"]

ServerRequest: Any = _SERVER_MANAGER["RobotServer"]
ManagerStatus: Any = _SERVER_MANAGER["Status"]
