"""Versions that answer a client which names none: moves of production, canaries, and versions that do not fit it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry

from bundles import rewrite_contract, write_box_policy
from rlservo.bundle.bundle import load_bundle
from rlservo.bundle.spaces import BoxSpec
from rlservo.client.policy_client import PolicyClient
from rlservo.client.remote_policy import RemotePolicy
from rlservo.client.stream_client import StreamClient
from rlservo.drive.control_loop import rollout
from rlservo.drive.fallback import WithFallback
from rlservo.errors import SessionLostError, UnavailableError, UnknownVersionError
from rlservo.export.renumber_bundle import renumber
from rlservo.policy.acting_policy import PRODUCTION
from rlservo.policy.options import PolicyOptions
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.deployment_plan import Canary, PolicyPlan
from rlservo.serve_app.versions.policy_store import PolicyStore
from servers import over_uvicorn
from stores import control_of

OBS = np.linspace(-1, 1, 27).astype(np.float32)
CLIENTS = pytest.mark.parametrize("kind", [PolicyClient, StreamClient])
Kind = type[PolicyClient | StreamClient]


@dataclass
class Server:
    """Versions 1, 2, ... of one policy; the first is in production until `move`."""

    policies: list[Policy]
    store: PolicyStore
    url: str = ""
    handler: RequestHandler | None = None

    def move(self, production: str, canary: str | None = None, share: float = 0.5, without: str = "") -> None:
        kept = [policy for policy in self.policies if policy.contract.version != without]
        plan = PolicyPlan(
            versions={policy.contract.version: policy.digest for policy in kept},
            aliases={PRODUCTION: production},
            canary=None if canary is None else Canary(version=canary, share=share),
        )
        self.store = PolicyStore(kept, {kept[0].contract.name: plan})

    def action(self, version: str) -> Any:
        return next(policy for policy in self.policies if policy.contract.version == version).act(OBS)

    def ends(self, name: str) -> dict[str, list[int]]:
        assert self.handler is not None
        counts, versions = self.handler.metrics.ends, {policy.contract.version for policy in self.policies}
        return {version: [counts.get((name, version, each), 0) for each in (True, False)] for version in versions}


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    with contextlib.ExitStack() as stack:

        def start(*folders: Path) -> Server:
            policies = [Policy.load(folder) for folder in folders]
            server = Server(policies, PolicyStore([], {}))
            server.move("1")
            app = create_app(control_of(lambda: server.store), ServerSettings())
            server.url = f"http://127.0.0.1:{stack.enter_context(over_uvicorn(app))}"
            server.handler = app.handler
            return server

        yield start


@pytest.fixture
def arms(serve: Callable[..., Server], tmp_path: Path) -> Server:
    return serve(*(write_box_policy(tmp_path, version=version, seed=seed) for seed, version in enumerate("12")))


@pytest.fixture
def recurrents(serve: Callable[..., Server], recurrent: Path, tmp_path: Path) -> Server:
    first = recurrent / "lstm_box" / "1"
    return serve(first, renumber(load_bundle(first), "2", tmp_path).path)


def test_canary_gets_its_share_of_the_episodes_and_each_of_them_one_version(arms: Server) -> None:
    arms.move("1", canary="2", share=0.5)
    expected = {version: arms.action(version) for version in "12"}
    chosen: list[str] = []
    with PolicyClient(arms.url, "ur5") as client:
        for _ in range(120):
            client.reset()
            for step in range(3):
                action = client.act(OBS)
                version = client.last_reply["version"]
                assert np.array_equal(action, expected[version]) and client.contract.version == version
                assert step == 0 or version == chosen[-1]
                chosen += [version] if step == 0 else []
    assert 35 <= chosen.count("2") <= 85  # of 120 fair coins, all but one in 300,000


def test_a_version_that_another_process_does_not_serve_yet_is_asked_for_again(
    arms: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    get = PolicyStore.get
    unknown = [UnknownVersionError("policy 'ur5' has no version '2'")] * 2

    def get_late(store: PolicyStore, name: str, version: str | None = None) -> Policy:
        if unknown and version == "2":
            raise unknown.pop()
        return get(store, name, version)

    monkeypatch.setattr(PolicyStore, "get", get_late)
    with PolicyClient(arms.url, "ur5") as client:
        assert np.array_equal(client.act(OBS), arms.action("1"))
        arms.move("2")
        assert np.array_equal(client.act(OBS), arms.action("2"))
    assert unknown == []


def test_canary_gets_its_share_of_streams(arms: Server) -> None:
    arms.move("1", canary="2", share=0.5)
    chosen: list[str] = []
    for _ in range(40):
        with StreamClient(arms.url, "ur5") as client:
            assert np.array_equal(client.act(OBS), arms.action(client.last_reply["version"]))
            chosen.append(client.last_reply["version"])
            client.reset()
            client.act(OBS)
            assert client.last_reply["version"] == chosen[-1]  # its connection is its session
    assert 4 <= chosen.count("2") <= 36


@pytest.mark.parametrize("server_state", [False, True])
def test_canary_gets_its_share_of_recurrent_episodes(recurrents: Server, server_state: bool) -> None:
    recurrents.move("1", canary="2", share=0.5)
    obs, chosen = np.zeros(3, np.float32), []
    with PolicyClient(recurrents.url, "lstm_box", server_state=server_state) as client:
        for _ in range(60):
            client.reset()
            client.act(obs)
            first = client.last_reply["version"]
            client.act(obs)
            assert client.last_reply["version"] == first
            client.outcome(1.0, terminated=True, final_obs=obs)
            chosen.append(first)
    assert 10 <= chosen.count("2") <= 50
    assert recurrents.handler is not None and not recurrents.handler.episodes.sessions.count()
    ends = recurrents.ends("lstm_box")
    assert [sum(ends[version]) for version in "12"] == [chosen.count("1"), chosen.count("2")]


@CLIENTS
def test_stateless_loop_follows_production_at_once(arms: Server, kind: Kind) -> None:
    with kind(arms.url, "ur5", deadline_ms=20_000) as client, kind(arms.url, "ur5", version="1") as fixed:
        assert fixed.contract.version == "1"
        for production in ("1", "2", "1", "2"):
            arms.move(production)
            for _ in range(2):
                assert np.array_equal(client.act(OBS), arms.action(production))
                assert client.contract.version == production
                assert np.array_equal(fixed.act(OBS), arms.action("1"))


@CLIENTS
def test_an_alias_is_looked_up_at_each_reset(arms: Server, kind: Kind) -> None:
    with kind(arms.url, "ur5", version=PRODUCTION, deadline_ms=20_000) as client:
        for before, production in ("11", "12", "21"):
            arms.move(production)
            assert np.array_equal(client.act(OBS), arms.action(before))  # the episode stays with its version
            client.reset()
            assert np.array_equal(client.act(OBS), arms.action(production))


def test_a_stream_without_a_name_gets_the_servers_default_policy(arms: Server) -> None:
    with StreamClient(arms.url) as client:
        assert client.contract.name == "ur5" and np.array_equal(client.act(OBS), arms.action("1"))
        assert client.reconnects == 0


@CLIENTS
@pytest.mark.parametrize("server_state", [False, True])
def test_episode_with_a_state_ends_with_the_version_that_began_it(
    recurrents: Server, kind: Kind, server_state: bool
) -> None:
    obs = np.full(3, 0.5, np.float32)
    with kind(recurrents.url, "lstm_box", server_state=server_state, deadline_ms=20_000) as client:
        expected = [recurrents.policies[0].act(obs) for _ in range(4)]
        for step, production in enumerate("1221"):
            recurrents.move(production)
            assert np.array_equal(client.act(obs), expected[step])
            assert client.last_reply["version"] == "1"
        recurrents.move("2")
        client.reset()
        assert np.array_equal(client.act(obs), expected[0]) and client.last_reply["version"] == "2"
        recurrents.move("1", without="2")
        with pytest.raises(SessionLostError):
            client.act(obs)
        client.reset()
        client.act(obs)
        assert client.last_reply["version"] == "1"


@CLIENTS
def test_version_that_remembers_takes_over_from_one_that_does_not(
    serve: Callable[..., Server], tmp_path: Path, kind: Kind
) -> None:
    one, two = (write_box_policy(tmp_path, version=version, seed=seed) for seed, version in enumerate("12"))
    server = serve(one)
    server.policies.append(Policy.load(two, options=PolicyOptions(max_action_step=0.01)))
    with kind(server.url, "ur5", deadline_ms=20_000) as client:
        client.act(OBS)
        server.move("2")
        client.act(OBS)
        assert client.last_reply["version"] == "2"
        server.move("1")
        client.reset()
        assert np.array_equal(client.act(OBS), server.action("1"))


@CLIENTS
def test_action_of_a_version_with_other_spaces_is_never_used(
    serve: Callable[..., Server], tmp_path: Path, kind: Kind
) -> None:
    one, two = (write_box_policy(tmp_path, version=version) for version in "12")
    space = Policy.load(one).contract.action_space
    assert isinstance(space, BoxSpec)
    rewrite_contract(two, action_space=space.model_copy(update={"elements": space.elements[::-1]}))
    server = serve(one, two)
    with kind(server.url, "ur5", deadline_ms=2000) as client:
        first = client.act(OBS)
        server.move("2")
        with pytest.raises(
            UnavailableError,
            match=r"version 2 of policy 'ur5' now answers, and differs from version 1, .*: action has 'joint_5' as "
            "element 0 instead of 5",
        ):
            client.act(OBS)
        held = WithFallback(client, [0.25] * 6)
        assert held.act(OBS).tolist() == [0.25] * 6 and held.counts.unavailable == 1
        server.move("1")
        assert np.array_equal(client.act(OBS), first)


class Reach(gym.Env[Any, Any]):
    """Two steps of the ur5 bundle's shape; its success is what the environment says."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (27,), np.float32)
    high = np.array([1, 1, 1, 2, 1, 1], np.float32)
    action_space = gym.spaces.Box(-high, high)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return OBS, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return OBS, 0.5, self.steps == 2, False, {"is_success": bool(action[0] > 0)}


@pytest.mark.parametrize("wrapped", [False, True])
@CLIENTS
def test_rollout_tells_the_server_how_episodes_ended(arms: Server, kind: Kind, wrapped: bool) -> None:
    arms.move("1", canary="2", share=1.0)
    register("Reached-v0", lambda: Reach())
    try:
        with kind(arms.url, "ur5", deadline_ms=20_000) as client:
            policy: Any = WithFallback(client, "hold") if wrapped else client
            report = rollout(policy, "Reached-v0", episodes=3)
    finally:
        del registry["Reached-v0"]
    has_succeeded = bool(arms.action("2")[0] > 0)
    assert (report.version, report.successes) == ("2", 3 * has_succeeded)
    assert arms.ends("ur5")["2"] == ([3, 0] if has_succeeded else [0, 3])


def test_server_that_takes_no_end_stops_no_loop(arms: Server, caplog: pytest.LogCaptureFixture) -> None:
    with PolicyClient(arms.url, "ur5", retries=0) as client:
        client.outcome(1.0, terminated=True, final_obs=OBS)  # nothing has begun
        client.act(OBS)
        arms.policies, kept = [], arms.policies
        arms.store = PolicyStore([], {})
        client.outcome(1.0, terminated=True, final_obs=OBS)
        assert (
            "the end of the episode was not reported to" in caplog.text and "no policy 'ur5' is loaded" in caplog.text
        )
        arms.policies = kept
        arms.move("1")
        assert isinstance(client, RemotePolicy) and np.array_equal(client.act(OBS), arms.action("1"))
