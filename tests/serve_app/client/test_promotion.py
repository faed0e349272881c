"""A promotion on a real server in this process: what becomes of good, bad and sabotaged canaries."""

from __future__ import annotations

import errno
import http.client
import itertools
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry

from rlservo.export.contract.errors import BundleError, ObservationError, UnavailableError, UsageError
from rlservo.serve_app.client import promotion
from rlservo.serve_app.client.admin_client import AdminClient
from rlservo.serve_app.client.policy_client import PolicyClient
from rlservo.serve_app.client.promotion import (
    INTERRUPTED,
    PROMOTED,
    ROLLED_BACK,
    STOPPED,
    UNDECIDED,
    Outcome,
    Promotion,
    Terms,
)
from rlservo.serve_app.client.promotion_conditions import parse_conditions
from rlservo.serve_app.client.promotion_counts import Counts
from rlservo.serve_app.client.promotion_log import PromotionLog
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.rollout.control_loop import rollout
from rlservo.serve_app.runtime import network_memory
from rlservo.serve_app.runtime.network_memory import NetworkMemory
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.api_keys import Keys, new_key
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.request_metrics import VersionCounts
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions import plan
from rlservo.serve_app.versions.replica_versions import ReplicaVersions, VersionState

Serve = Callable[[Any], AbstractContextManager[int]]
KEY, LINE = new_key("boss", admin=True)
OBS = [0.5] * 27
EVERY_S = 10.0
CONFIG = {"policies": {"ur5": {"aliases": {"production": "1"}}}}


@dataclass
class Server:
    """A server with ur5 in 1, 2 (the same network), 3 (its actions leave the space) and 4 (another network)."""

    port: int
    control: ReplicaVersions
    core: Core
    numbers: Iterator[int] = field(default_factory=itertools.count)

    @contextmanager
    def admin(self) -> Iterator[AdminClient]:
        with AdminClient(f"http://127.0.0.1:{self.port}", api_key=KEY) as client:
            yield client

    @property
    def plan(self) -> Any:
        assert self.control.plan is not None
        return self.control.plan.policies["ur5"]

    def ask(self, requests: int, **fields: Any) -> None:
        """Ask so often, each time as another session."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        for _ in range(requests):
            headers = {"content-type": "application/json", "x-session-id": f"cell-{next(self.numbers)}"}
            connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS, **fields}), headers)
            connection.getresponse().read()
        connection.close()
        while not self.core.shadows._waiting.empty():
            time.sleep(0.01)


@pytest.fixture(scope="module")
def running(
    box_policy: Callable[..., Path], controlled: Any, served: Serve, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Server]:
    root = tmp_path_factory.mktemp("promotion")
    for version, seed, scale in (("1", 0, 1.0), ("2", 0, 1.0), ("3", 0, 400.0), ("4", 7, 1.0)):
        box_policy(root, version=version, seed=seed, action_scale=scale)
    with controlled(root, config=CONFIG, load=partial(Policy.load, memory=NetworkMemory(1 << 30))) as control:
        settings = ServerSettings(operator_key=LINE.split()[-1])
        app = create_app(lambda: control.store, settings, replica="only", control=control)
        with served(app) as port:
            yield Server(port, control, app.state.core)


@pytest.fixture
def server(running: Server) -> Server:
    with running.admin() as admin:
        for version in ("1", "2", "3", "4"):
            admin.load("ur5", version)
        admin.canary("ur5", None)
        admin.shadow("ur5", None)
        admin.alias("ur5", "production", "1")
    return running


@dataclass
class Run:
    """A promotion whose time passes as it sleeps; `steps` is what happens then, one after the other."""

    server: Server
    log: Path
    terms: Terms
    said: list[str] = field(default_factory=list)
    now: float = 0.0

    def __call__(self, *steps: Callable[[], object], key: str = KEY, port: int | None = None) -> Outcome:
        waiting = iter(steps)

        def sleep(seconds: float) -> None:
            step = next(waiting, None)
            if step is not None:
                step()
            self.now += seconds

        url = f"http://127.0.0.1:{port or self.server.port}"
        with PromotionLog.open(self.log) as log:
            promotion = Promotion(
                lambda: AdminClient(url, api_key=key),
                self.terms,
                parse_conditions(self.terms.unless),
                log,
                every_s=EVERY_S,
                say=self.said.append,
                sleep=sleep,
                clock=lambda: self.now,
            )
            try:
                return promotion.run()
            finally:
                promotion.close()

    @property
    def entries(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def events(self) -> list[str]:
        return [entry["event"] for entry in self.entries]


@pytest.fixture
def run(server: Server, tmp_path: Path) -> Callable[..., Run]:
    def make(version: str = "2", unless: str = "error_rate>5%", **terms: Any) -> Run:
        given = {"share": 0.5, "seconds": 3 * EVERY_S, "min_requests": 20, "min_episodes": 20, **terms}
        return Run(server, tmp_path / "log.jsonl", Terms("a server", "ur5", version, unless=unless, **given))

    return make


def test_a_good_canary_is_promoted_and_the_log_has_its_figures(run: Any, server: Server) -> None:
    promotion = run(unless="error_rate>1% or latency_p99>1s or action_difference>0.05")
    seen: list[Any] = []

    def step() -> None:
        seen.append((server.plan.canary.version, server.plan.canary.share, server.plan.shadow))
        server.ask(110)

    outcome = promotion(step, step, step)
    assert outcome.outcome == PROMOTED, outcome
    assert seen[0] == ("2", 0.5, "2")
    assert (server.plan.default, server.plan.canary, server.plan.shadow) == ("2", None, None)
    assert "0 of" in outcome.why and outcome.why.endswith("2 is in production, no canary runs")
    assert promotion.events() == ["start", "started", "check", "check", "check", "check", "decision", "end"]
    first, *_, last = (entry for entry in promotion.entries if entry["event"] == "check")
    assert first["requests"] == 0 and 100 < last["requests"] < 230
    assert last["requests"] + last["requests_in_production"] == 330
    rate, latency, difference = last["figures"]
    assert (rate["value"], rate["count"]) == (0.0, last["requests"])
    assert 0 < latency["low"] <= latency["value"] <= latency["high"] < 1
    assert difference["value"] == 0.0 and difference["count"] > 50
    with server.admin() as admin:  # a way back is kept
        assert admin.rollback("ur5", "production")["default"] == "1"


def test_a_bad_canary_is_rolled_back_long_before_the_time_is_over(run: Any, server: Server) -> None:
    promotion = run("3", seconds=1000 * EVERY_S)
    outcome = promotion(lambda: server.ask(20))
    assert outcome.outcome == ROLLED_BACK and "unsafe-action" in outcome.why, outcome
    assert (server.plan.default, server.plan.canary) == ("1", None)
    assert promotion.now == EVERY_S
    counts = server.core.metrics.counts("ur5")
    assert counts["3"].failed["unsafe-action"] >= 3 and "unsafe-action" not in counts["1"].failed


def test_a_failure_of_a_canary_drawn_by_chance_is_its_own(server: Server) -> None:
    counts = server.core.metrics.counts("ur5")
    before, failed = counts.get("1"), counts.get("3", VersionCounts()).failed.get("unsafe-action", 0)
    with server.admin() as admin:
        admin.canary("ur5", "3", 1.0)
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS}), {"content-type": "application/json"})
    assert connection.getresponse().status == 500
    connection.close()
    counts = server.core.metrics.counts("ur5")
    assert counts["3"].failed["unsafe-action"] == failed + 1
    assert before is None or counts["1"].failed == before.failed


def test_actions_that_differ_roll_back(run: Any, server: Server) -> None:
    outcome = run("4", "action_difference>0.05")(lambda: server.ask(120), lambda: server.ask(1))
    assert outcome.outcome == ROLLED_BACK and "action_difference>0.05: it is" in outcome.why, outcome
    assert (server.plan.default, server.plan.canary, server.plan.shadow) == ("1", None, None)


def test_a_shadow_that_ran_before_goes_on_and_another_one_is_in_the_way(run: Any, server: Server) -> None:
    with server.admin() as admin:
        admin.shadow("ur5", "2")
    outcome = run(unless="action_difference>0.05")(lambda: server.ask(150))
    assert outcome.outcome == PROMOTED and server.plan.shadow == "2"
    with server.admin() as admin:
        admin.alias("ur5", "production", "1")
        admin.shadow("ur5", "4")
    with pytest.raises(UsageError, match="has a shadow already, 4"):
        run(unless="action_difference>0.05")()
    assert server.plan.canary is None


class Reach(gym.Env[Any, Any]):
    """One step, which succeeds if it is version 1's."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (27,), np.float32)
    high = np.array([1, 1, 1, 2, 1, 1], np.float32)
    action_space = gym.spaces.Box(-high, high)

    def __init__(self, wanted: Any) -> None:
        self.wanted = wanted

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.array(OBS, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        is_there = bool(np.allclose(action, self.wanted))
        return np.array(OBS, np.float32), 1.0, True, False, {"final_status": "success" if is_there else "collision"}


def test_success_is_compared_by_the_ends_that_rollouts_tell(run: Any, server: Server) -> None:
    assert server.control.store is not None
    wanted = server.control.store.get("ur5", "1").act(np.array(OBS, np.float32))
    register("Promoted-v0", lambda: Reach(wanted))

    def episodes() -> None:
        with PolicyClient(f"http://127.0.0.1:{server.port}", "ur5") as client:
            rollout(client, "Promoted-v0", episodes=150)

    try:
        outcome = run("4", "success_drop>2%")(episodes)
    finally:
        del registry["Promoted-v0"]
    assert outcome.outcome == ROLLED_BACK and "episodes succeeded" in outcome.why, outcome
    assert (server.plan.default, server.plan.canary) == ("1", None)


def test_ends_of_sessions_that_chance_sends_anywhere_are_not_counted(server: Server) -> None:
    before = {version: list(counts.ends) for version, counts in server.core.metrics.counts("ur5").items()}
    with server.admin() as admin:
        admin.canary("ur5", "2", 0.5)
    for version, expected in ((None, 0), ("2", 1)):
        path = "act" if version is None else f"versions/{version}/act"
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        document = json.dumps({"obs": OBS, "final_status": "success"})
        connection.request("POST", f"/v1/policies/ur5/{path}", document, {"content-type": "application/json"})
        assert connection.getresponse().status == 200
        connection.close()
        now = {version: list(counts.ends) for version, counts in server.core.metrics.counts("ur5").items()}
        assert sum(map(sum, now.values())) - sum(map(sum, before.values())) == expected


@pytest.mark.parametrize(
    ("unless", "requests", "says"),
    [
        ("error_rate>1%", 10, "too little traffic to judge"),
        ("error_rate>0.1%", 200, "and not 1,000"),
        ("success_drop>2%", 200, "0 of 0 episodes"),
    ],
)
def test_too_little_is_neither_promoted_nor_called_bad(
    run: Any, server: Server, unless: str, requests: int, says: str
) -> None:
    outcome = run(unless=unless)(lambda: server.ask(requests))
    assert outcome.outcome == UNDECIDED and says in outcome.why, outcome
    assert (server.plan.default, server.plan.canary) == ("1", None)


def alias(admin: AdminClient) -> None:
    admin.alias("ur5", "production", "4")


def alias_to_ours(admin: AdminClient) -> None:
    admin.alias("ur5", "production", "2")


def other_share(admin: AdminClient) -> None:
    admin.canary("ur5", "2", 0.9)


def other_canary(admin: AdminClient) -> None:
    admin.canary("ur5", "4", 0.5)


def no_canary(admin: AdminClient) -> None:
    admin.canary("ur5", None)


def unload_version(admin: AdminClient) -> None:
    admin.canary("ur5", None)
    admin.shadow("ur5", None)
    admin.unload("ur5", "2")


def no_shadow(admin: AdminClient) -> None:
    admin.shadow("ur5", None)


@pytest.mark.parametrize(
    ("sabotage", "says", "left"),
    [
        (alias, "'production' leads to 4 and no longer to 1", ("4", None)),
        (alias_to_ours, "'production' leads to 2 and no longer to 1", ("2", None)),
        (other_share, "the canary is 2=0.9 and no longer 2=0.5", ("1", ("2", 0.9))),
        (other_canary, "the canary is 4=0.5 and no longer 2=0.5", ("1", ("4", 0.5))),
        (no_canary, "the canary is none and no longer 2=0.5", ("1", None)),
        (unload_version, "version 2 is no longer loaded", ("1", None)),
        (no_shadow, "the shadow is none and no longer 2", ("1", None)),
    ],
)
def test_somebody_elses_change_stops_it_and_is_left_as_it_is(
    run: Any, server: Server, sabotage: Callable[[AdminClient], None], says: str, left: Any
) -> None:
    def step() -> None:
        server.ask(60)
        with server.admin() as admin:
            sabotage(admin)

    outcome = run(unless="error_rate>1% or action_difference>1")(step)
    assert outcome.outcome == STOPPED and says in outcome.why and "the last change was" in outcome.why, outcome
    canary = server.plan.canary
    assert (server.plan.default, canary and (canary.version, canary.share)) == left
    assert server.plan.shadow is None


def test_an_alias_that_is_moved_in_the_last_moment_is_not_moved_back(run: Any, server: Server) -> None:
    promotion = run()
    look = Promotion._changed
    calls = itertools.count()

    def changed(self: Any, state: Any, served: Any) -> str | None:  # after the last look, before the command
        found = look(self, state, served)
        if next(calls) == 4:
            with server.admin() as admin:
                alias(admin)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Promotion, "_changed", changed)
        outcome = promotion(lambda: server.ask(200))
    assert next(calls) == 5
    assert outcome.outcome == STOPPED and "leads to 4 and was expected at 1" in outcome.why, outcome
    assert (server.plan.default, server.plan.canary) == ("4", None)


def test_a_server_that_is_started_anew_stops_it(run: Any, server: Server) -> None:
    """Its changes count from 1 again; replicas that have not followed yet are older, too, but not for long."""
    before = server.control.plan
    assert before is not None

    def start_anew() -> None:
        server.control.plan = before.model_copy(update={"generation": 1})

    try:
        outcome = run(seconds=100 * EVERY_S)(lambda: server.ask(60), start_anew)
    finally:
        with server.admin() as admin:  # the ledger has not forgotten
            admin.canary("ur5", None)
    assert outcome.outcome == STOPPED and "a new start of the server has changed what is served" in outcome.why
    assert "the canary is none and no longer 2=0.5" in outcome.why


def test_a_bug_in_a_canary_is_its_own(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    with server.admin() as admin:
        admin.canary("ur5", "2", 1.0)
    before = server.core.metrics.counts("ur5").get("2")
    failed = 0 if before is None else before.failed.get("internal", 0)
    monkeypatch.setattr(Policy, "step", lambda *_, **__: 1 / 0)
    server.ask(3)
    assert server.core.metrics.counts("ur5")["2"].failed["internal"] == failed + 3


def test_a_canary_whose_network_cannot_be_opened_is_rolled_back(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise BundleError("policy.onnx is gone")

    monkeypatch.setattr(network_memory, "open_graph", fail)
    assert server.control.store is not None
    network = server.control.store.get("ur5", "2").droppable
    assert network is not None
    promotion = run("2", seconds=1000 * EVERY_S)
    try:
        outcome = promotion(network.drop, lambda: server.ask(20))
    finally:
        monkeypatch.undo()
        monkeypatch.setattr(network_memory, "RETRY_S", 0.0)
        network.restore()
    assert outcome.outcome == ROLLED_BACK and "requests failed by network-away" in outcome.why, outcome


def test_what_robots_send_wrong_is_not_the_canarys(run: Any, server: Server) -> None:
    def ask_wrongly() -> None:
        server.ask(20, obs=OBS[1:])
        server.ask(20, obs=[*OBS[1:], math.nan])
        server.ask(20, obs=OBS, no_such_field=1)
        server.ask(20, obs=OBS, deadline_ms=1e-6)

    outcome = run("2", share=1.0)(lambda: server.ask(40), ask_wrongly)
    assert outcome.outcome == PROMOTED, outcome
    failed = server.core.metrics.counts("ur5")["2"].failed
    assert failed["bad-observation"] >= 20  # it is counted, and not held against it


def test_a_canary_that_refuses_what_production_takes_is_rolled_back(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Policy.step

    def refuse(policy: Policy, *given: Any, **named: Any) -> Any:
        if policy.contract.version == "2":
            raise ObservationError("element 0 is outside the observation space")
        return step(policy, *given, **named)

    monkeypatch.setattr(Policy, "step", refuse)
    outcome = run("2", seconds=1000 * EVERY_S)(lambda: server.ask(20))
    assert outcome.outcome == ROLLED_BACK and "requests failed by stricter-than-production" in outcome.why, outcome


@pytest.mark.parametrize("follows", [True, False])
def test_what_a_replica_cannot_serve_is_not_promoted(
    follows: bool, run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = server.control.states

    def states() -> Any:
        return {"ur5": {**own()["ur5"], "2": VersionState("failed", "its golden vectors differ")}}

    def fall_behind() -> None:
        server.ask(60)
        monkeypatch.setattr(server.control, "states", states)

    waits: list[Callable[[], object]] = [lambda: None] * 4  # one more than the time that it has
    outcome = run("2")(fall_behind, *waits, *([monkeypatch.undo] if follows else []))
    if follows:
        assert outcome.outcome == PROMOTED, outcome
    else:
        assert (outcome.outcome, server.plan.default) == (ROLLED_BACK, "1"), outcome
        assert "not every replica can serve it: replica only: version 2: its golden vectors differ" in outcome.why


def test_a_policy_that_is_unloaded_stops_it(run: Any, server: Server) -> None:
    def step() -> None:
        with server.admin() as admin:
            admin.unload("ur5")

    outcome = run()(step)
    assert outcome.outcome == STOPPED and "'ur5' is no longer served" in outcome.why


def test_killed_half_way_it_goes_on_with_what_was_counted(run: Any, server: Server) -> None:
    def kill() -> None:
        raise SystemExit(143)

    promotion = run(seconds=3600.0)
    with pytest.raises(SystemExit):
        promotion(lambda: server.ask(60), kill)
    assert server.plan.canary.version == "2" and "end" not in promotion.events()
    counted = promotion.entries[-1]["requests"] + promotion.entries[-1]["requests_in_production"]
    assert counted == 60
    server.ask(50)  # nobody watches
    with promotion.log.open("a") as torn:
        torn.write('{"time": "2026-')  # it was killed while it wrote
    again = replace(promotion, now=0.0, said=[])
    again.terms = promotion.terms

    def end_of_time() -> None:
        server.ask(90)
        again.now += 3600

    outcome = again(end_of_time)
    assert outcome.outcome == PROMOTED, outcome
    assert any("goes on" in line for line in again.said)
    lines = [line for line in again.log.read_text().splitlines() if not line.startswith('{"time": "2026-{')]
    checks = [entry for line in lines if (entry := _entry(line)) is not None and entry["event"] == "check"]
    assert checks[-1]["requests"] + checks[-1]["requests_in_production"] == 200
    assert server.plan.default == "2"


def _entry(line: str) -> dict[str, Any] | None:
    try:
        return dict(json.loads(line))
    except ValueError:
        return None


def test_killed_between_the_decision_and_its_end_it_is_carried_out(run: Any, server: Server) -> None:
    promotion = run()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Promotion, "_attempt", lambda *_: (_ for _ in ()).throw(SystemExit(137)))
        with pytest.raises(SystemExit):
            promotion(lambda: server.ask(200))
    assert promotion.events()[-1] == "decision" and server.plan.default == "1"
    outcome = promotion()
    assert outcome.outcome == PROMOTED and (server.plan.default, server.plan.canary) == ("2", None)
    assert promotion.events()[-1] == "end"


def test_other_terms_do_not_go_on_with_it_and_a_second_process_waits_for_the_first(run: Any, server: Server) -> None:
    def kill() -> None:
        raise SystemExit(143)

    promotion = run()
    with pytest.raises(SystemExit):
        promotion(kill)
    with pytest.raises(UsageError, match="is not finished, with other terms"):
        run(share=0.4)()
    whole = promotion.log.read_text()
    promotion.log.write_text(whole.replace('"own_shadow"', '"own"'))
    with pytest.raises(UsageError, match="cannot be read"):
        promotion()
    promotion.log.write_text(whole)
    with PromotionLog.open(promotion.log), pytest.raises(UsageError, match="another 'rlservo policy promote' writes"):
        promotion()
    assert server.plan.canary is not None


def test_ctrl_c_rolls_back_and_says_so(run: Any, server: Server) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    outcome = run()(lambda: server.ask(200), interrupt)
    assert outcome.outcome == INTERRUPTED and outcome.why.endswith("1 is in production, no canary runs")
    assert server.plan.canary is None


def test_a_dry_run_watches_what_is_there_and_changes_nothing(run: Any, server: Server) -> None:
    with server.admin() as admin:
        admin.canary("ur5", "2", 0.3)
    before = server.control.plan
    outcome = run(dry_run=True)(lambda: server.ask(200))
    assert outcome.outcome == PROMOTED and "nothing was changed" in outcome.why
    assert server.control.plan is before


def test_a_server_out_of_reach_is_waited_for_and_then_it_stops_and_can_go_on(
    run: Any, server: Server, served: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = AdminClient.counts
    away = [False]

    def unreachable(self: AdminClient, name: str) -> Any:
        if away[0]:
            raise UnavailableError("nobody is there")
        return counts(self, name)

    monkeypatch.setattr(AdminClient, "counts", unreachable)

    def leave() -> None:
        server.ask(200)
        away[0] = True

    promotion = run(seconds=10 * EVERY_S)
    outcome = promotion(leave)
    assert outcome.outcome == STOPPED and not outcome.is_finished
    assert "told no counts for 60 s" in outcome.why and "policy canary ur5 off" in outcome.why
    assert promotion.events().count("unreachable") > 5 and server.plan.canary is not None
    away[0] = False
    outcome = promotion()  # what was decided is carried out
    assert outcome.outcome == STOPPED and outcome.is_finished and server.plan.canary is None


def test_a_short_silence_costs_nothing(run: Any, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    counts, failures = AdminClient.counts, iter([True] * 3)

    def flaky(self: AdminClient, name: str) -> Any:
        if server.plan.canary is not None and next(failures, False):
            raise UnavailableError("nobody is there")
        return counts(self, name)

    monkeypatch.setattr(AdminClient, "counts", flaky)
    assert run(seconds=6 * EVERY_S)(lambda: server.ask(200)).outcome == PROMOTED


@pytest.mark.parametrize(
    ("version", "says"),
    [("9", "has no version 9: loaded are 1, 2, 3, 4"), ("1", "in production already")],
)
def test_what_cannot_be_promoted_is_refused_before_anything_is_changed(
    run: Any, server: Server, version: str, says: str
) -> None:
    before, promotion = server.control.plan, run(version)
    with pytest.raises(UsageError, match=says):
        promotion()
    assert server.control.plan is before and not promotion.log.exists()


def test_a_canary_of_somebody_else_is_in_the_way(run: Any, server: Server) -> None:
    with server.admin() as admin:
        admin.canary("ur5", "2", 0.5)
    with pytest.raises(UsageError, match=r"has a canary already, 2=0\.5"):
        run()()


def reply(replica: str, answered: int, failed: int = 0) -> dict[str, Any]:
    counts = {"2": {"latency": [answered, 0], "failed": {"internal": failed}, "ends": [0, 0]}}
    return {"replica": replica, "counts": counts, "comparisons": []}


def totals(*looks: Sequence[dict[str, Any]]) -> tuple[dict[str, float], list[list[str]]]:
    counts = Counts()
    counts.begin(looks[0], ("1", "2"))
    return counts.total, [counts.add(look, ("1", "2")) for look in looks[1:]]


def test_counts_are_increments_over_replicas_that_come_go_and_begin_anew() -> None:
    total, restarted = totals(
        [reply("a", 100), reply("b", 50)],
        [reply("a", 110), reply("b", 60)],
        [reply("a", 112)],  # b was killed: what it counted stays
        [reply("a", 5), reply("c", 7)],  # a began anew, c came
        [reply("a", 6), reply("c", 7), reply("b", 61)],
    )
    assert total["2/latency/0"] == 10 + 10 + 2 + 5 + 7 + 1 + 1
    assert restarted == [[], [], ["a"], []]


@pytest.mark.parametrize("content", ["hello\n", '{"a": 1}\n', "[1]\n"])
def test_a_file_that_is_no_log_is_not_written_to(tmp_path: Path, content: str) -> None:
    file = tmp_path / "notes"
    file.write_text(content)
    with pytest.raises(UsageError, match="is none of a promotion's log"), PromotionLog.open(file):
        pass
    assert file.read_text() == content


class Killed(BaseException):
    """What no handler sees, as SIGKILL."""


@contextmanager
def killed_at(is_over: Callable[[list[str]], bool]) -> Iterator[list[str]]:
    """Die at one of the moments before and after each entry of the log and each command, by those that were."""
    moments: list[str] = []

    def dying(function: Callable[..., Any], what: Callable[..., str]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            def pass_by(when: str) -> None:
                moments.append(f"{when} {what(*given)}")
                if is_over(moments):
                    raise Killed

            pass_by("before")
            result = function(*given, **named)
            pass_by("after")
            return result

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PromotionLog, "write", dying(PromotionLog.write, lambda _, event: f"'{event}' is written"))
        patch.setattr(AdminClient, "_command", dying(AdminClient._command, lambda _, n, command, d: f"{command} {d}"))
        yield moments


def test_killed_at_any_moment_and_started_again_it_is_carried_out_once(run: Any, server: Server) -> None:
    unless = "error_rate>20% or action_difference>1"
    for number in itertools.count():
        promotion = run(unless=unless, seconds=2 * EVERY_S, min_requests=5)
        try:
            with killed_at(lambda moments, most=number: len(moments) > most) as moments:  # type: ignore[misc]
                promotion(*[lambda: server.ask(20)] * 3)
        except Killed:
            moment = moments[-1]
        else:
            break
        try:
            outcome = promotion(*[lambda: server.ask(20)] * 3)
        except UsageError as error:
            assert moment == "after 'end' is written" and "in production already" in error.message
        else:
            assert outcome.outcome == PROMOTED and outcome.is_finished, (moment, outcome)
        plan = server.plan
        assert (plan.default, plan.canary, plan.shadow) == ("2", None, None), moment
        assert promotion.events().count("end") == 1
        promotion.log.unlink()
        with server.admin() as admin:
            admin.alias("ur5", "production", "1")
    assert number >= 24 and promotion.events()[-1] == "end"


def test_a_promotion_that_was_undone_is_not_done_again(run: Any, server: Server) -> None:
    promotion = run()
    with pytest.raises(Killed), killed_at(lambda moments: moments[-1].startswith("after alias")):
        promotion(lambda: server.ask(200))
    assert server.plan.default == "2"
    with server.admin() as admin:
        admin.rollback("ur5", "production")
    outcome = promotion()
    assert outcome.outcome == STOPPED and outcome.is_finished and "may have been undone (the last change" in outcome.why
    assert (server.plan.default, server.plan.canary) == ("1", None)


@pytest.mark.parametrize("entry", ["start", "started", "check", "decision", "end"])
def test_a_log_that_cannot_be_written_is_a_sentence_and_promotes_nothing(
    run: Any, server: Server, entry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_full, written = [False], os.write

    def write(descriptor: int, content: bytes) -> int:
        is_full[0] |= f'"event": "{entry}"'.encode() in content
        if is_full[0] and b'"event": ' in content:
            raise OSError(errno.ENOSPC, "No space left on device")
        return written(descriptor, content)

    promotion = run()
    monkeypatch.setattr("rlservo.serve_app.client.promotion_log.os.write", write)
    says = r"the log .*log\.jsonl cannot be written: No space left on device"
    if entry == "start":
        with pytest.raises(UsageError, match=says):
            promotion(lambda: server.ask(200))
    else:
        outcome = promotion(lambda: server.ask(200))
        assert outcome.outcome == (PROMOTED if entry == "end" else STOPPED), outcome
        assert re.search(says, " ".join([outcome.why, *promotion.said]))
    assert (server.plan.default, server.plan.canary) == ("2" if entry == "end" else "1", None)


@pytest.mark.parametrize(("jump_s", "left"), [(-1e9, "10 s are left"), (1e9, "0 s are left")])
def test_a_clock_that_was_set_while_nobody_watched_adds_no_time(
    run: Any, server: Server, jump_s: float, left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill() -> None:
        raise Killed

    promotion = run(seconds=2 * EVERY_S)
    with pytest.raises(Killed):
        promotion(lambda: server.ask(20), kill)
    promotion.now = 0.0
    now = time.time
    monkeypatch.setattr("rlservo.serve_app.client.promotion.time.time", lambda: now() + jump_s)
    idle = [lambda: None] * 9
    outcome = promotion(lambda: server.ask(60), *idle, lambda: pytest.fail("it goes on for ever"))
    assert any(f"goes on: {left}" in line for line in promotion.said), promotion.said
    assert outcome.outcome == (PROMOTED if jump_s < 0 else UNDECIDED) and server.plan.canary is None


def test_a_key_that_is_revoked_stops_it_and_the_way_on_is_said(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = ServerSettings(operator_key=new_key("another", admin=True)[1].split()[-1])

    def revoke() -> None:
        server.ask(200)
        monkeypatch.setattr(server.core.keys, "accepted", Keys.from_settings(others))

    promotion = run()
    outcome = promotion(revoke)
    assert outcome.outcome == STOPPED and not outcome.is_finished
    assert "takes the admin key no longer" in outcome.why and "'rlservo policy canary ur5 off' ends" in outcome.why
    assert server.plan.canary is not None
    monkeypatch.undo()
    outcome = promotion()
    assert outcome.outcome == STOPPED and outcome.is_finished and server.plan.canary is None


def test_the_alias_that_a_promotion_moves_is_the_one_that_servers_follow() -> None:
    """Two constants: the client imports nothing of the server."""
    assert promotion.PRODUCTION == plan.PRODUCTION
