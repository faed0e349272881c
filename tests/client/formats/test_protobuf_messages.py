"""Message classes built at run time, on the wire as protobuf defines it."""

from __future__ import annotations

import pytest
from google.protobuf import descriptor_pool

from rlservo.protobuf_messages import build_messages


def test_every_kind_of_field_has_its_number_and_type_on_the_wire() -> None:
    built = build_messages(
        "a.b",
        {
            "Outer": [
                "repeated float values",
                "map Outer.Inner by_name",
                "oneof either bool yes",
                "oneof either string text = 17",
            ],
            "Outer.Inner": ["int64 count"],
        },
    )
    message = built["Outer"](values=[1.0, -2.0], by_name={"x": built["Outer.Inner"](count=3)}, text="t")
    # tag = number << 3 | wire type: 0 varint, 2 length and content
    assert message.SerializeToString() == (
        b"\x0a\x08\x00\x00\x80\x3f\x00\x00\x00\xc0"  # 1: packed floats
        b"\x12\x07\x0a\x01x\x12\x02\x08\x03"  # 2: an entry, of key (1) and value (2)
        b"\x8a\x01\x01t"  # 17
    )
    assert message.WhichOneof("either") == "text"
    message.yes = True
    assert message.WhichOneof("either") == "yes" and message.text == ""
    assert built["Outer"].DESCRIPTOR.full_name == "a.b.Outer"


def test_the_process_wide_pool_stays_free_for_generated_code() -> None:
    build_messages("inference", {"ModelInferRequest": ["string other"]})
    with pytest.raises(KeyError):
        descriptor_pool.Default().FindMessageTypeByName("inference.ModelInferRequest")
