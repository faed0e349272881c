"""The acting graph: no value head, and the same actions."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from rlservo.errors import UsageError
from rlservo.policy import acting_graph, loading
from rlservo.policy.acting_graph import without_value
from rlservo.policy.policy import Policy

SHIPPED = Path(__file__).resolve().parents[2] / "examples" / "checkpoints" / "ur5_positioning"


def branch(name: str, factor: str) -> Any:
    """A graph inside a node, which takes `hidden` and a factor from the one around it."""
    output = helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 2])
    return helper.make_graph([helper.make_node("Mul", ["hidden", factor], [name])], name, [], [output])


def model() -> Any:
    """`action` by way of an If, `value` from what both share and from weights of its own."""
    values = {"one": [1.0], "two": [2.0], "weights": np.eye(2), "own": np.ones((2, 1)), "upper": [1.0]}
    floats = [
        helper.make_tensor(name, TensorProto.FLOAT, np.shape(value), np.ravel(value)) for name, value in values.items()
    ]
    condition = helper.make_tensor("condition", TensorProto.BOOL, [], [True])
    nodes = [
        helper.make_node("MatMul", ["obs", "weights"], ["hidden"]),
        helper.make_node("MatMul", ["hidden", "own"], ["critic"]),
        helper.make_node("Tanh", ["critic"], ["value"]),
        helper.make_node(
            "If", ["condition"], ["scaled"], then_branch=branch("a", "one"), else_branch=branch("b", "two")
        ),
        helper.make_node("Clip", ["scaled", "", "upper"], ["action"]),
    ]
    shapes = {"action": ["batch", 2], "value": ["batch", 1]}
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
    obs = helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["batch", 2])
    graph = helper.make_graph(nodes, "policy", [obs], outputs, [*floats, condition])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    made.metadata_props.add(key="kept", value="yes")
    for name in ("own", "weights"):  # as older exporters list them: inputs with a default
        made.graph.input.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, np.shape(values[name])))
    onnx.checker.check_model(made)
    return made


def test_only_what_the_value_alone_needs_is_left_out() -> None:
    whole = model()
    rest = onnx.load_from_string(without_value(whole.SerializeToString()))
    onnx.checker.check_model(rest)
    assert [output.name for output in rest.graph.output] == ["action"]
    assert [tensor.name for tensor in rest.graph.input] == ["obs", "weights"]
    assert [node.op_type for node in rest.graph.node] == ["MatMul", "If", "Clip"]
    assert {tensor.name for tensor in rest.graph.initializer} == {"one", "two", "weights", "upper", "condition"}
    assert rest.metadata_props == whole.metadata_props and rest.opset_import == whole.opset_import
    feed = {"obs": np.array([[0.25, 3.0]], np.float32)}
    actions = [
        onnxruntime.InferenceSession(each.SerializeToString()).run(["action"], feed)[0] for each in (whole, rest)
    ]
    assert np.array_equal(*actions) and actions[0].tolist() == [[0.25, 1.0]]


def test_nodes_may_come_in_any_order() -> None:
    whole = model()
    sorted_rest = onnx.load_from_string(without_value(whole.SerializeToString()))
    nodes = list(whole.graph.node)[::-1]
    del whole.graph.node[:]
    whole.graph.node.extend(nodes)
    rest = onnx.load_from_string(without_value(whole.SerializeToString()))
    assert list(rest.graph.node) == list(sorted_rest.graph.node)[::-1]


@pytest.mark.trained
def test_a_large_graph_is_opened_as_it_is(exported: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Making it again holds the interpreter's lock, during which no policy acts."""
    folder = exported(SHIPPED).path
    monkeypatch.setattr(loading, "LARGEST_MADE", 1000)
    monkeypatch.setattr(acting_graph, "without_value", None)  # would fail
    policy = Policy.load(folder)
    assert policy.value(np.zeros(27)) is not None


@pytest.mark.trained
def test_a_policy_acts_as_the_whole_graph_does_and_still_has_its_value(exported: Callable[..., Any]) -> None:
    folder = exported(SHIPPED).path
    whole = onnxruntime.InferenceSession(folder / "policy.onnx")
    policy = Policy.load(folder)
    obs = np.random.default_rng(0).uniform(-0.5, 0.5, (64, 27)).astype(np.float32)
    for one in (obs, obs[0], obs[1].tolist()):
        given = np.array(one, np.float32).reshape(-1, 27)
        action, value = whole.run(["action", "value"], {"obs": given})
        np.testing.assert_array_equal(np.reshape(policy.act(one), action.shape), action)
        np.testing.assert_array_equal(policy.value(one), value)
    policy.close()
    with pytest.raises(UsageError, match=re.escape("closed")):
        policy.value(obs)
