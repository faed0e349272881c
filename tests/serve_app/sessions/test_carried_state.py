"""Memory that clients carry: given to the version it belongs to, over every protocol, with the last action in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from bundles import write_box_policy, write_leaky_policy
from grpc_calls import GrpcCall, answered, infer_request
from rlservo.bundle.contract import TensorSpec
from rlservo.client.policy_client import PolicyClient
from rlservo.client.stream_client import StreamClient
from rlservo.errors import RequestError, SessionLostError, UnknownVersionError
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.policy.recurrent_state import StateTensors
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.deployment_plan import PolicyPlan
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from stores import control_of, store_of
from streams import Stream

OBS = [0.5, -0.25, 1.0]
LIMIT = 0.05


@dataclass
class Server:
    """A server whose store a test exchanges."""

    url: str
    app: Any
    store: PolicyStore

    def act(self, path: str, **request: Any) -> tuple[int, Any]:
        reply = httpx.post(f"{self.url}/v1/policies/{path}/act", json={"obs": OBS, **request})
        return reply.status_code, reply.json()

    def infer(self, path: str, tensors: dict[str, Any], **parameters: Any) -> tuple[int, Any]:
        inputs = [
            {"name": name, "shape": list(np.shape(value)), "datatype": "FP32", "data": np.asarray(value).tolist()}
            for name, value in tensors.items()
        ]
        reply = httpx.post(f"{self.url}/v2/models/{path}/infer", json={"inputs": inputs, "parameters": parameters})
        return reply.status_code, reply.json()


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Policy]:
    """Three graphs that take each other's states: two versions, and the second one exported again."""
    root = tmp_path_factory.mktemp("leaky")
    again = tmp_path_factory.mktemp("again")
    return {
        "1": Policy.load(write_leaky_policy(root, version="1", seed=1)),
        "2": Policy.load(write_leaky_policy(root, version="2", seed=2)),
        "2 again": Policy.load(write_leaky_policy(again, version="2", seed=3)),
        "other": Policy.load(write_leaky_policy(root, name="other", seed=4)),
    }


@pytest.fixture(scope="module")
def everything(versions: dict[str, Policy]) -> Iterator[Server]:
    held: list[Server] = []
    app = create_app(control_of(lambda: held[0].store), ServerSettings())
    with over_uvicorn(app) as port:
        held.append(Server(f"http://127.0.0.1:{port}", app, store_of(versions["1"])))
        yield held[0]


@pytest.fixture
def server(everything: Server, versions: dict[str, Policy]) -> Server:
    everything.store = store_of(versions["1"])
    return everything


def promoted(versions: dict[str, Policy]) -> PolicyStore:
    return store_of(versions["1"], versions["2"], versions["other"])


def in_process(policy: Policy, steps: int) -> list[list[float]]:
    policy.reset()
    return [policy.act(OBS).tolist() for _ in range(steps)]


def test_a_state_stays_with_its_version_whatever_becomes_the_default(
    server: Server, versions: dict[str, Policy]
) -> None:
    expected = in_process(versions["1"], 3)
    _, first = server.act("leaky", state={})
    server.store = promoted(versions)
    status, second = server.act("leaky", state=first["state"])
    assert (status, second["version"]) == (200, "1")
    _, third = server.act("leaky/versions/1", state=second["state"])
    np.testing.assert_allclose([first["action"], second["action"], third["action"]], expected, rtol=1e-6)
    assert server.act("leaky", state={})[1]["version"] == "2"  # the next episode is the new version's

    status, reply = server.act("leaky/versions/2", state=first["state"])
    assert (status, reply["code"]) == (409, "session-conflict") and "belongs to version 1" in reply["error"]
    status, reply = server.act("other", state=first["state"])
    assert (status, reply["code"]) == (410, "session-lost") and "'leaky/1#" in reply["error"]
    server.store = store_of(versions["2"])
    status, reply = server.act("leaky", state=first["state"])
    assert (status, reply["code"]) == (410, "session-lost") and "begin an episode (state {})" in reply["error"]
    _, first = server.act("leaky", state={})
    server.store = store_of(versions["2 again"])  # the same name and version, and another network
    assert server.act("leaky", state=first["state"])[0] == 410


def test_a_state_without_a_version_is_only_used_where_it_can_be_of_one_alone(
    server: Server, versions: dict[str, Policy]
) -> None:
    bare = {"h": [0.5, 0.5]}
    assert server.act("leaky", state=bare)[0] == 200
    plans = {"leaky": PolicyPlan(versions={"1": "", "2": ""}, aliases={"production": "2"})}
    server.store = PolicyStore([versions["1"], versions["2"]], plans)
    for path in ("leaky", "leaky/versions/production"):
        status, reply = server.act(path, state=bare)
        assert status == 400 and "does not name its version" in reply["error"], reply
        assert "('@policy' in 'state', or the parameter 'state_policy'), or name the version" in reply["error"]
    assert server.act("leaky/versions/2", state=bare)[1]["version"] == "2"
    server.store = store_of(versions["2"], before=server.store)  # version 1 was here until a moment ago
    assert server.act("leaky", state=bare)[0] == 400


@pytest.mark.parametrize(
    ("state", "sentence"),
    [
        ({"@policy": None}, "missing h"),  # nothing that begins an episode by accident
        ({"@policy": 1, "h": [0, 0]}, "must be the string from the last reply"),
        ({"@secret": 1, "h": [0, 0]}, "unknown entry '@secret'"),
        ({"@last_action": [0.1]}, "missing h"),
    ],
)
def test_what_a_state_says_of_itself_is_read_strictly(server: Server, state: Any, sentence: str) -> None:
    status, reply = server.act("leaky", state=state)
    assert status == 400 and sentence in reply["error"], reply


def test_the_open_inference_protocol_tells_and_takes_whose_a_state_is(
    server: Server, versions: dict[str, Policy]
) -> None:
    _, first = server.infer("leaky", {"obs": [OBS]}, sequence_start=True)
    states = {one["name"]: np.reshape(one["data"], one["shape"]) for one in first["outputs"]}
    owner = first["parameters"]["state_policy"]
    tensors = {"obs": [OBS], "state_in.h": states["state_out.h"]}
    server.store = promoted(versions)
    status, second = server.infer("leaky", tensors, state_policy=owner)
    assert (status, second["model_version"]) == (200, "1")
    assert server.infer("leaky/versions/1", tensors)[0] == 200  # a client that names its version needs no more
    status, reply = server.infer("leaky", tensors)
    assert status == 400 and "the parameter 'state_policy'" in reply["error"]
    status, reply = server.infer("leaky/versions/2", tensors, state_policy=owner)
    assert (status, reply["code"]) == (409, "session-conflict")
    assert server.infer("leaky", {"obs": [OBS]}, state_policy=owner, sequence_start=True)[1]["model_version"] == "2"


def test_so_does_grpc(server: Server, versions: dict[str, Policy]) -> None:
    def infer(state: bytes | None, **parameters: Any) -> tuple[Any, GrpcCall]:
        request = infer_request([OBS], "leaky", **parameters)
        if state is not None:
            request.inputs.add(name="state_in.h", datatype="FP32", shape=[1, 2])
            request.raw_input_contents.append(state)
        return answered(server.app.handler, request)

    first, _ = infer(None, sequence_start=True)
    state, owner = first.raw_output_contents[1], first.parameters["state_policy"].string_param
    server.store = promoted(versions)
    second, _ = infer(state, state_policy=owner)
    assert second.model_version == "1"
    _, refused = infer(state)
    assert "the parameter 'state_policy'" in refused.details


def test_a_stream_hands_a_carried_state_to_its_version(server: Server, versions: dict[str, Policy]) -> None:
    port, path = int(server.url.rpartition(":")[2]), "/v1/policies/leaky/stream?errors=keep"
    obs = np.float32(OBS)
    with Stream(port, path) as stream:
        first = stream.ask(obs=obs, state={})
    server.store = promoted(versions)
    with Stream(port, path) as stream:  # the connection broke meanwhile
        assert stream.metadata["version"] == "2"
        second = stream.ask(obs=obs, state=first["state"])
        assert second["version"] == "1"
        assert "does not name its version" in stream.ask(obs=obs, state={"h": first["state"]["h"]})["error"]
    np.testing.assert_allclose(second["actions"][0], in_process(versions["1"], 2)[1], rtol=1e-6)


@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
def test_our_clients_go_on_with_their_version_and_learn_when_it_is_gone(
    server: Server, versions: dict[str, Policy], kind: type[PolicyClient | StreamClient]
) -> None:
    expected = in_process(versions["1"], 2)
    with kind(server.url, "leaky") as client:
        first = client.act(OBS)
        server.store = promoted(versions)
        np.testing.assert_allclose([first, client.act(OBS)], expected, rtol=1e-6)
        server.store = store_of(versions["2"])
        with pytest.raises((SessionLostError, UnknownVersionError)):
            client.act(OBS)


# The step from one action to the next.


@pytest.fixture
def limited(server: Server, versions: dict[str, Policy], tmp_path: Path) -> Server:
    options = PolicyOptions(max_action_step=LIMIT)
    folders = [write_box_policy(tmp_path), versions["1"].path]
    server.store = store_of(*(Policy.load(folder, options=options) for folder in folders))
    return server


def steps(policy: Any, size: int, count: int = 4) -> list[Any]:
    """Return the actions of an episode whose observations jump."""
    policy.reset()
    return [policy.act(np.full(size, (-1.0) ** step, np.float32)) for step in range(count)]


@pytest.mark.parametrize("name", ["ur5", "leaky"])
@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
@pytest.mark.parametrize("server_state", [False, True])
def test_clients_act_as_in_process_where_the_step_is_limited(
    limited: Server, name: str, kind: type[PolicyClient | StreamClient], server_state: bool
) -> None:
    here = limited.store.get(name).clone()
    size = here.contract.observation_space.shape[0]  # type: ignore[union-attr]
    with kind(limited.url, name, server_state=server_state) as client:
        for _ in range(2):  # an episode's first action is limited by nothing
            np.testing.assert_allclose(steps(client, size), expected := steps(here, size), rtol=1e-5, atol=1e-6)
    jumps = np.abs(np.diff(expected, axis=0))
    assert jumps.max() == pytest.approx(LIMIT, rel=1e-3)  # and it was


def test_a_refusal_names_what_to_send_over_every_protocol(limited: Server) -> None:
    status, reply = limited.act("ur5", obs=[0.0] * 27)
    assert status == 400 and reply["details"] == {"send": "state"}
    for what in ("'state' ({} begins an episode", "'last_action'", "'session_id' with 'reset'"):
        assert what in reply["error"]
    status, reply = limited.infer("ur5", {"obs": [[0.0] * 27]})
    for what in ("an input", "'sequence_start'", "'sequence_id'"):
        assert status == 400 and what in reply["error"]


def test_the_last_action_is_an_input_of_the_open_inference_protocol(limited: Server) -> None:
    listed = httpx.get(f"{limited.url}/v2/models/ur5").json()["inputs"]
    assert {"name": "last_action", "datatype": "FP32", "shape": [-1, 6]} in listed
    obs = np.stack([np.ones(27), -np.ones(27)]).astype(np.float32)
    _, begun = limited.infer("ur5", {"obs": obs}, sequence_start=True)
    last = np.reshape(begun["outputs"][0]["data"], (2, 6))
    status, reply = limited.infer("ur5", {"obs": -obs, "last_action": last})
    step = np.abs(np.reshape(reply["outputs"][0]["data"], (2, 6)) - last).max()
    assert status == 200 and step == pytest.approx(LIMIT, rel=1e-3)
    status, reply = limited.infer("ur5", {"obs": -obs, "last_action": last[:1]})
    assert status == 422 and "different batch sizes" in reply["error"]


def test_an_action_that_came_too_late_is_not_what_the_next_one_is_measured_from(limited: Server) -> None:
    up, down = np.ones(27, np.float32), -np.ones(27, np.float32)
    for kind in (PolicyClient, StreamClient):
        with kind(limited.url, "ur5", server_state=True) as client:
            used = client.act(up)
            # What a late reply leaves behind: the server has gone on, the robot has not.
            unseen = client.act(down)
            client.set_last_action(used)
            assert np.abs(unseen - used).max() > 0
            np.testing.assert_allclose(client.act(down), unseen, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["ur5", "leaky"])
@pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
@pytest.mark.parametrize("server_state", [False, True])
def test_what_the_robot_was_commanded_instead_is_what_the_next_step_is_measured_from(
    limited: Server, name: str, kind: type[PolicyClient | StreamClient], server_state: bool
) -> None:
    policy = limited.store.get(name)
    size = policy.contract.observation_space.shape[0]  # type: ignore[union-attr]
    with kind(limited.url, name, server_state=server_state) as client:
        for _ in range(2):
            client.reset()
            used = client.act(np.ones(size, np.float32))
            instead = np.where(used > 0, -1.0, 1.0).astype(np.float32)
            client.set_last_action(instead)
            after = client.act(np.ones(size, np.float32))
            assert np.abs(after - instead).max() == pytest.approx(LIMIT, rel=1e-3)
            again = client.act(np.ones(size, np.float32))  # said once: from here the server knows
            assert np.abs(again - after).max() == pytest.approx(LIMIT, rel=1e-3)
            # Two observations have no last action of this shape: it is not sent, and nothing else is in its way.
            client.reset()
            client.set_last_action(instead)
            assert client.act(np.ones((2, size), np.float32)).shape[0] == 2
            if server_state:
                client.reset()


def test_a_reward_is_seen_where_nothing_else_is_remembered(versions: dict[str, Policy]) -> None:
    contract = versions["1"].contract
    reward = TensorSpec(name="reward", dtype="float32", shape=(-1,))
    with_state = StateTensors(contract.model_copy(update={"inputs": (*contract.inputs, reward)}))
    assert with_state.inputs(None, 1, 2.5)["reward"] == 0  # an episode begins: nothing has been earned
    alone = StateTensors(contract.model_copy(update={"inputs": (contract.inputs[0], reward), "state": ()}))
    assert alone.inputs(None, 1, 2.5)["reward"] == 2.5
    with pytest.raises(RequestError, match="0 at an episode's start"):
        alone.inputs(None, 1, None)
