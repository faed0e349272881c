"""Model configuration and statistics that Triton's tools ask for before they infer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bundles import write_box_policy, write_leaky_policy
from grpc_calls import answered
from rlservo.policy.options import PolicyOptions
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.open_inference.model_info import METHODS, statistics
from rlservo.serve_app.protocols.open_inference.oip_messages import messages
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.deployment_plan import PolicyPlan
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import exchange, over_uvicorn
from stores import control_of, load_store

OPTIONS = {
    "careful": PolicyOptions(max_action_step=0.1),
    "*": PolicyOptions(),
}
Ask = Callable[..., tuple[int, Any]]


@pytest.fixture(scope="module")
def store(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> PolicyStore:
    root = tmp_path_factory.mktemp("more")
    write_box_policy(root, name="careful")
    write_leaky_policy(root)
    return load_store(policies, root, options=OPTIONS)


@pytest.fixture(scope="module")
def app(store: PolicyStore) -> Any:
    return create_app(control_of(store), ServerSettings(max_batch=64, session_idle_s=90))


@pytest.fixture(scope="module")
def ask(app: Any) -> Iterator[Ask]:
    with over_uvicorn(app) as port:

        def call(path: str, body: Any = None) -> tuple[int, Any]:
            reply = exchange(port, "GET" if body is None else "POST", path, body)
            return reply.status, reply.document

        yield call


def test_the_configuration_says_how_a_policy_is_run(ask: Ask) -> None:
    status, config = ask("/v2/models/ur5/config")
    assert status == 200
    assert config == {
        "name": "ur5",
        "platform": "onnx_onnxv1",
        "backend": "onnxruntime",
        "max_batch_size": 64,
        "input": [{"name": "obs", "data_type": "TYPE_FP32", "dims": [27]}],
        "output": [{"name": "action", "data_type": "TYPE_FP32", "dims": [6]}],
        "default_model_filename": "policy.onnx",
        "model_transaction_policy": {"decoupled": False},
    }
    assert ask("/v2/models/ur5/versions/2/config") == (200, config)
    discrete = ask("/v2/models/gridworld/config")[1]
    assert discrete["input"] == [{"name": "obs", "data_type": "TYPE_INT64", "dims": []}]


def test_the_configuration_says_what_needs_a_sequence(ask: Ask) -> None:
    assert "sequence_batching" not in ask("/v2/models/ur5/config")[1]
    leaky = ask("/v2/models/leaky/config")[1]
    assert leaky["input"][1] == {"name": "state_in.h", "data_type": "TYPE_FP32", "dims": [2], "optional": True}
    assert "optional" not in leaky["input"][0]
    state = {"input_name": "state_in.h", "output_name": "state_out.h", "data_type": "TYPE_FP32", "dims": [2]}
    assert leaky["sequence_batching"] == {"max_sequence_idle_microseconds": 90_000_000, "state": [state]}
    careful = ask("/v2/models/careful/config")[1]
    assert careful["input"][1] == {"name": "last_action", "data_type": "TYPE_FP32", "dims": [6], "optional": True}
    assert careful["sequence_batching"] == {"max_sequence_idle_microseconds": 90_000_000, "state": []}


def test_every_input_and_output_of_the_metadata_is_in_the_configuration(ask: Ask, store: PolicyStore) -> None:
    for name in store.names:
        model, config = ask(f"/v2/models/{name}")[1], ask(f"/v2/models/{name}/config")[1]
        for listed, configured in ((model["inputs"], config["input"]), (model["outputs"], config["output"])):
            assert [(t["name"], f"TYPE_{t['datatype']}", t["shape"]) for t in listed] == [
                (t["name"], t["data_type"], [-1, *t["dims"]]) for t in configured
            ]


def test_an_alias_means_its_version(store: PolicyStore) -> None:
    plan = PolicyPlan(versions={"1": "", "2": "", "10": ""}, aliases={"production": "2"})
    aliased = PolicyStore([store.get("ur5", version) for version in ("1", "2", "10")], {"ur5": plan})
    handler = create_app(control_of(aliased), ServerSettings()).handler
    assert [each["version"] for each in statistics(handler, "ur5", "production")["model_stats"]] == ["2"]
    assert [each["version"] for each in statistics(handler, "ur5")["model_stats"]] == ["1", "2", "10"]


def tensor(rows: int) -> dict[str, Any]:
    data = np.random.default_rng(rows).standard_normal((rows, 27)).ravel().tolist()
    return {"inputs": [{"name": "obs", "shape": [rows, 27], "datatype": "FP32", "data": data}]}


def test_statistics_count_what_was_answered_over_every_protocol(ask: Ask) -> None:
    def of(version: str) -> Any:
        status, reply = ask(f"/v2/models/ur5/versions/{version}/stats")
        assert status == 200
        (only,) = reply["model_stats"]
        return only

    untouched = of("1")
    assert (untouched["last_inference"], untouched["inference_count"], untouched["execution_count"]) == (0, 0, 0)
    assert set(untouched["inference_stats"]) == {
        "success", "fail", "queue", "compute_input", "compute_infer", "compute_output", "cache_hit", "cache_miss"
    }  # fmt: skip
    assert all(each == {"count": 0, "ns": 0} for each in untouched["inference_stats"].values())
    before, began_ms = of("10"), time.time() * 1e3
    for rows in (1, 1, 5):
        assert ask("/v2/models/ur5/infer", tensor(rows))[0] == 200
    assert ask("/v1/policies/ur5/act", {"obs": [0.1] * 27})[0] == 200
    assert ask("/v2/models/ur5/infer", {"inputs": [{**tensor(1)["inputs"][0], "name": "speed"}]})[0] == 422
    assert ask("/v2/models/ur5/versions/10/infer", {"inputs": []})[0] == 400
    after = of("10")
    assert (before["inference_count"], before["execution_count"]) == (0, 0)
    assert (after["inference_count"], after["execution_count"]) == (8, 4)
    counts = {name: each["count"] for name, each in after["inference_stats"].items()}
    assert counts == {"success": 4, "fail": 2, "cache_hit": 0, "cache_miss": 0} | dict.fromkeys(
        ("queue", "compute_input", "compute_infer", "compute_output"), 4
    )  # perf_analyzer ends where these differ
    success, computed = after["inference_stats"]["success"]["ns"], after["inference_stats"]["compute_infer"]["ns"]
    assert success > computed > 4 * 1000
    assert began_ms - 1 <= after["last_inference"] <= time.time() * 1e3 + 1
    assert of("1") == untouched
    versions = ask("/v2/models/ur5/stats")[1]["model_stats"]
    assert [each["version"] for each in versions] == ["1", "2", "10"] and versions[2] == after
    everything = ask("/v2/models/stats")[1]["model_stats"]
    assert {each["name"] for each in everything} == {"careful", "gridworld", "leaky", "ur5"}


@pytest.mark.parametrize("kind", ["config", "stats"])
def test_what_is_not_served_is_named(ask: Ask, kind: str) -> None:
    status, reply = ask(f"/v2/models/nobody/{kind}")
    assert status == 404 and "no policy 'nobody' is loaded" in reply["error"]
    status, reply = ask(f"/v2/models/ur5/versions/77/{kind}")
    assert status == 404 and "has no version '77'" in reply["error"]


def test_extensions_name_both(ask: Ask) -> None:
    assert {"model_configuration", "statistics"} <= set(ask("/v2")[1]["extensions"])


def over_grpc(store: PolicyStore, method: str, **fields: str) -> Any:
    """Return the reply to a call without an action, None if it failed."""
    handler = create_app(control_of(store), ServerSettings()).handler
    reply, call = answered(handler, getattr(messages, f"{method}Request")(**fields), method=method)
    return reply if call.code is None else None


def test_grpcs_messages_take_every_field_of_the_documents(store: PolicyStore) -> None:
    """A field that a message lacks fails the call: the two forms cannot drift apart."""
    for name in store.names:
        for method in METHODS:
            named = {"name": name} if method.startswith("Model") else {}
            assert over_grpc(store, method, **named) is not None, method
        config = over_grpc(store, "ModelConfig", name=name).config
        assert config.input[0].data_type in (9, 11) and config.name == name  # Triton's TYPE_INT64 and TYPE_FP32
    assert len(over_grpc(store, "ModelStatistics").model_stats) == 6
    assert over_grpc(store, "ModelReady", name="ur5").ready and not over_grpc(store, "ModelReady", name="ur6").ready
    assert over_grpc(store, "ModelMetadata", name="ur6") is None
