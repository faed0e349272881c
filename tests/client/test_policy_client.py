"""The client against the real server application, over a real socket, with real exported policies behind it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import uvicorn
from gymnasium.envs.registration import register, registry
from numpy.typing import NDArray

from rlservo.client.policy_client import PolicyClient
from rlservo.drive.control_loop import rollout
from rlservo.errors import (
    ObservationError,
    RequestError,
    UnavailableError,
    UnknownPolicyError,
    UnknownVersionError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import PolicyStore
from stores import control_of, load_store


class ArmShaped(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Ten steps through numbers of the ur5 bundle's shape; each depends on the action before."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (27,), np.float32)
    high = np.array([1, 1, 1, 2, 1, 1], np.float32)
    action_space = gym.spaces.Box(-high, high)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.standard_normal(27).astype(np.float32), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.steps += 1
        obs = np.resize(action, 27) + self.np_random.standard_normal(27)
        return obs.astype(np.float32), float(action.sum()), False, self.steps == 10, {}


class Served:
    """The application on a port of its own; `store` None is a server that is still loading."""

    def __init__(self, store: PolicyStore | None) -> None:
        self.store = store
        app = create_app(control_of(lambda: self.store), ServerSettings())
        config = uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning", ws="none", lifespan="off")
        self.uvicorn = uvicorn.Server(config)
        self._thread = threading.Thread(target=self.uvicorn.run)

    def __enter__(self) -> Served:
        self._thread.start()
        deadline = time.monotonic() + 20
        while not self.uvicorn.started:
            assert time.monotonic() < deadline, "uvicorn did not start"
            time.sleep(0.01)
        port = self.uvicorn.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{port}"
        return self

    def __exit__(self, *_: object) -> None:
        self.uvicorn.should_exit = True
        self._thread.join()


@pytest.fixture(scope="module")
def served(policies: Path) -> Iterator[Served]:
    store = load_store(policies)
    with Served(store) as running:
        yield running
    store.close()


@pytest.fixture
def client(served: Served) -> Iterator[PolicyClient]:
    with PolicyClient(served.url, "ur5") as made:
        yield made


def observations(count: int) -> NDArray[np.float32]:
    return np.random.default_rng(3).standard_normal((count, 27)).astype(np.float32)


def test_client_and_in_process_policy_give_the_same_actions(client: PolicyClient, ur5: Path) -> None:
    with Policy.load(ur5) as policy:
        assert client.contract == policy.contract
        for obs in observations(10):
            over_http, in_process = client.act(obs), policy.act(obs)
            assert over_http.dtype == in_process.dtype and over_http.shape == in_process.shape
            assert np.array_equal(over_http, in_process)


def test_a_batch_gives_a_batch(client: PolicyClient, ur5: Path) -> None:
    with Policy.load(ur5) as policy:
        actions = client.act(observations(5))
        assert actions.shape == (5, 6)
        assert np.array_equal(actions, policy.act(observations(5)))
        assert client.act(observations(1)).shape == (1, 6)


def test_named_elements_are_sent_by_name(client: PolicyClient) -> None:
    obs = observations(2)
    named = {f"element_{i}": float(obs[0, i]) for i in range(27)}
    assert np.array_equal(client.act(named), client.act(obs[0]))
    batch = {f"element_{i}": obs[:, i] for i in range(27)}
    assert np.array_equal(client.act(batch), client.act(obs))


def test_lists_and_other_dtypes_give_the_same_action(client: PolicyClient) -> None:
    obs = np.round(observations(1)[0] * 8) / 8
    expected = client.act(obs)
    for same in (obs.tolist(), obs.astype(np.float64), obs.astype(">f4"), np.repeat(obs, 2)[::2]):
        assert np.array_equal(client.act(same), expected)


def test_discrete_observations_and_actions_are_single_integers(served: Served, policies: Path) -> None:
    with PolicyClient(served.url, "gridworld") as client, Policy.load(policies / "gridworld") as policy:
        for state in range(5):
            action = client.act(state)
            assert (action.shape, action.dtype) == ((), np.int64)
            assert action == policy.act(np.int64(state)) == client.act(np.array(state))
        assert client.act(np.arange(5)).shape == (5,)


def test_the_same_seed_explores_the_same_way_over_http(client: PolicyClient, ur5: Path) -> None:
    obs = observations(1)[0]
    with Policy.load(ur5) as policy:
        explored = client.act(obs, explore=True, seed=7)
        assert np.array_equal(explored, policy.act(obs, explore=True, seed=7))
    assert not np.array_equal(explored, client.act(obs, explore=True, seed=8))
    assert not np.array_equal(explored, client.act(obs))


def test_the_newest_version_is_the_default_and_another_can_be_named(served: Served, policies: Path) -> None:
    obs = observations(1)[0]
    with PolicyClient(served.url, "ur5") as newest, PolicyClient(served.url, "ur5", version="2") as second:
        assert (newest.contract.version, second.contract.version) == ("10", "2")
        with Policy.load(policies / "ur5" / "2") as policy:
            assert np.array_equal(second.act(obs), policy.act(obs))
        assert not np.array_equal(second.act(obs), newest.act(obs))


def test_a_newer_version_loaded_meanwhile_does_not_change_a_loop_with_a_version(policies: Path) -> None:
    obs = observations(1)[0]
    old = load_store(policies / "ur5" / "1", policies / "ur5" / "2")
    with Served(old) as server, PolicyClient(server.url, "ur5", version="2") as client:
        before = client.act(obs)
        server.store = load_store(policies)
        assert np.array_equal(client.act(obs), before)
        assert client.contract.version == "2"
        server.store = load_store(policies / "ur5" / "10")
        with pytest.raises(UnknownVersionError, match="has no version '2'"):
            client.act(obs)
        server.store.close()


def test_an_observation_of_the_wrong_length_is_an_observation_error_with_the_servers_sentence(
    client: PolicyClient,
) -> None:
    with pytest.raises(ObservationError, match=r"policy 'ur5' expects obs of shape \(27,\), got \(26,\)") as caught:
        client.act(np.zeros(26, np.float32))
    assert caught.value.details["expected_shape"] == [27]
    assert client.act(np.zeros(27, np.float32)).shape == (6,)  # the server still serves


def test_a_misnamed_element_is_an_observation_error(client: PolicyClient) -> None:
    with pytest.raises(ObservationError, match="missing 'element_26'; unknown 'elbow'"):
        client.act({**{f"element_{i}": 0.0 for i in range(26)}, "elbow": 0.0})


def test_unknown_policies_and_versions_are_named_with_what_exists(served: Served) -> None:
    with PolicyClient(served.url, "ur6") as client:
        with pytest.raises(UnknownPolicyError, match="no policy 'ur6' is loaded: this server has gridworld, ur5"):
            client.act(np.zeros(27))
        with pytest.raises(UnknownPolicyError):
            client.wait_until_ready(timeout_s=30)  # waiting does not cure it: raises at once
    with PolicyClient(served.url, "ur5", version="3") as client, pytest.raises(UnknownVersionError, match="1, 2, 10"):
        client.act(np.zeros(27))


def test_a_name_may_be_left_out_where_the_server_has_one_policy(served: Served, policies: Path) -> None:
    with (
        PolicyClient(served.url) as client,
        pytest.raises(UsageError, match="has 2 policies: name one of gridworld, ur5"),
    ):
        client.act(np.zeros(27))
    with Served(load_store(policies / "gridworld")) as small, PolicyClient(small.url) as client:
        assert client.contract.name == "gridworld"
        assert client.act(2).shape == ()


def test_a_server_that_is_still_loading_is_waited_for(policies: Path) -> None:
    with Served(None) as loading, PolicyClient(loading.url, "ur5", timeout_s=0.5) as client:
        with pytest.raises(UnavailableError, match="still being loaded"):
            client.act(np.zeros(27))
        with pytest.raises(UnavailableError, match=r"was not ready within 0\.3 s: .*still being loaded"):
            client.wait_until_ready(timeout_s=0.3)
        threading.Timer(0.3, lambda: setattr(loading, "store", load_store(policies / "ur5" / "2"))).start()
        client.wait_until_ready(timeout_s=20)
        assert client.act(np.zeros(27)).shape == (6,)


def test_a_wrong_address_path_says_where_things_are(served: Served) -> None:
    with PolicyClient(f"{served.url}/robots", "ur5") as client, pytest.raises(RequestError, match="nothing at"):
        client.act(np.zeros(27))


def test_a_connection_that_idled_out_is_reopened_without_a_word(policies: Path) -> None:
    store = load_store(policies / "ur5" / "2")
    with Served(store) as server, PolicyClient(server.url, "ur5") as client:
        server.uvicorn.config.timeout_keep_alive = 0  # uvicorn closes idle connections at once
        first = client.act(np.zeros(27))
        time.sleep(0.2)
        assert np.array_equal(client.act(np.zeros(27)), first)


def test_a_rollout_over_http_is_the_rollout_in_process(client: PolicyClient, ur5: Path) -> None:
    register(id="client-tests/ArmShaped-v0", entry_point=ArmShaped)
    try:
        over_http = rollout(client, "client-tests/ArmShaped-v0", episodes=3, seed=2)
        with Policy.load(ur5) as policy:
            in_process = rollout(policy, "client-tests/ArmShaped-v0", episodes=3, seed=2)
    finally:
        del registry["client-tests/ArmShaped-v0"]
    assert [row.episode_return for row in over_http.episodes] == [row.episode_return for row in in_process.episodes]
    assert len({row.episode_return for row in over_http.episodes}) == 3
    assert over_http.latency_ms is not None and in_process.latency_ms is not None
    assert over_http.latency_ms.p50 > in_process.latency_ms.p50  # it did go over the wire
