"""robo-gym's protobuf messages, built when this module is imported: no generated code to fit the protobuf in use.

Source of names and numbers: jr-robotics/robo-gym-server-modules, robot_server.proto and server_manager.proto. The
classes live in a descriptor pool of their own, so that a process may load robo-gym's generated ones as well.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

ROBOT_SERVER = "robot_server.RobotServer"
SERVER_MANAGER = "robo_gym_server_manager.grpc_msgs.server_manager.ServerManager"

_Field = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "bool": _Field.TYPE_BOOL,
    "int32": _Field.TYPE_INT32,
    "float": _Field.TYPE_FLOAT,
    "string": _Field.TYPE_STRING,
}
_MESSAGES: dict[str, dict[str, list[str]]] = {
    # package -> message -> fields in the order of their numbers
    "robot_server": {
        "Success": ["bool success"],
        "Empty": [],
        "Action": ["repeated float action", "bool success"],
        "State": [
            "repeated float state",
            "map<string,float> float_params",
            "map<string,string> string_params",
            "map<string,float> state_dict",
            "bool success",
        ],
    },
    "robo_gym_server_manager.grpc_msgs.server_manager": {
        "RobotServer": ["string cmd", "bool gui", "int32 port", "bool success", "string info"],
        "Status": ["bool alive"],
        "Empty": [],
    },
}


def _file(package: str) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    for name, fields in _MESSAGES[package].items():
        message = file.message_type.add(name=name)
        for number, declaration in enumerate(fields, start=1):
            _add_field(message, f".{package}.{name}", number, declaration)
    return file


def _add_field(message: Any, path: str, number: int, declaration: str) -> None:
    kind, name = declaration.rsplit(" ", 1)
    field = message.field.add(name=name, number=number, label=_Field.LABEL_OPTIONAL)
    if kind.startswith("map<"):  # on the wire a repeated message of key and value
        entry_name = "".join(part.capitalize() for part in name.split("_")) + "Entry"
        entry = message.nested_type.add(name=entry_name)
        entry.options.map_entry = True
        for entry_number, (part, of) in enumerate(zip(("key", "value"), kind[4:-1].split(","), strict=True), start=1):
            entry.field.add(name=part, number=entry_number, label=_Field.LABEL_OPTIONAL, type=_TYPES[of])
        field.label, field.type, field.type_name = _Field.LABEL_REPEATED, _Field.TYPE_MESSAGE, f"{path}.{entry_name}"
        return
    if kind.startswith("repeated "):
        field.label = _Field.LABEL_REPEATED
    field.type = _TYPES[kind.removeprefix("repeated ")]


_pool = descriptor_pool.DescriptorPool()
for _package in _MESSAGES:
    _pool.AddSerializedFile(_file(_package).SerializeToString())


def _message(package: str, name: str) -> Any:
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{package}.{name}"))


# Classes made at run time have no static type: Any is all a type checker can be told.
Success: Any = _message("robot_server", "Success")
Empty: Any = _message("robot_server", "Empty")
Action: Any = _message("robot_server", "Action")
State: Any = _message("robot_server", "State")

ServerRequest: Any = _message("robo_gym_server_manager.grpc_msgs.server_manager", "RobotServer")
ManagerStatus: Any = _message("robo_gym_server_manager.grpc_msgs.server_manager", "Status")
