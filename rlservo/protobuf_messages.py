"""Protobuf message classes built at run time from a short description: no generated code.

Generated code is tied to its protobuf version, and registers its names in the process-wide descriptor pool, as others
do (KServe's and Triton's packages, robo-gym's). These classes have their own pool.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_Field = descriptor_pb2.FieldDescriptorProto
_DECLARATION = re.compile(r"(?:(map|repeated|oneof (\w+)) )?(\S+) (\w+)(?: = (\d+))?")
_TYPES = {name.removeprefix("TYPE_").lower(): number for name, number in _Field.Type.items()}


def build_messages(
    package: str,
    messages: Mapping[str, Sequence[str]],
    *,
    enums: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return the classes of a proto3 package by name.

    `messages` lists each one's fields in the order of their numbers, or with explicit numbers: `int64 ns`,
    `repeated float action`, `map float limits` (from string), `bool ready = 17`, `oneof choice bool yes` (of the only
    oneof of a message). A type is a protobuf scalar or a message. A nested message is written Outer.Inner, after its
    outer one. `enums` lists the values' names of each enumeration, from 0.
    """
    file = descriptor_pb2.FileDescriptorProto(name=f"rlservo/{package}.proto", package=package, syntax="proto3")
    for name, values in (enums or {}).items():
        file.enum_type.add(name=name, value=[{"name": value, "number": at} for at, value in enumerate(values)])
    made: dict[str, Any] = {}
    for name, fields in messages.items():
        outer, _, inner = name.rpartition(".")
        message = made[outer].nested_type.add(name=inner) if outer else file.message_type.add(name=inner)
        made[name] = message
        for position, declaration in enumerate(fields, start=1):
            _add_field(message, package, name, position, declaration)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    # Classes made at run time have no static type, hence Any.
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}")) for name in messages}


def _add_field(message: Any, package: str, path: str, position: int, declaration: str) -> None:
    ((modifier, oneof, kind, name, number),) = _DECLARATION.findall(declaration)
    field = message.field.add(name=name, number=int(number or position), label=_Field.LABEL_OPTIONAL)
    if modifier == "map":  # on the wire: a repeated message of key and value
        entry = message.nested_type.add(name="".join(part.capitalize() for part in name.split("_")) + "Entry")
        entry.options.map_entry = True
        _add_field(entry, package, path, 1, "string key")
        _add_field(entry, package, path, 2, f"{kind} value")
        modifier, kind = "repeated", f"{path}.{entry.name}"
    if modifier == "repeated":
        field.label = _Field.LABEL_REPEATED
    elif oneof:
        if not message.oneof_decl:
            message.oneof_decl.add(name=oneof)
        field.oneof_index = 0
    if kind in _TYPES:
        field.type = _TYPES[kind]
    else:
        field.type_name = f".{package}.{kind}"  # of a message or an enumeration
