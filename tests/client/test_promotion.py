"""A promotion on a real server in this process: the outcome of good, bad and sabotaged canaries."""

from __future__ import annotations

import errno
import http.client
import itertools
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry

from bundles import controlled, write_box_policy
from rlservo.client.admin_client import AdminClient
from rlservo.client.policy_client import PolicyClient
from rlservo.client.promotion import (
    INTERRUPTED,
    PROMOTED,
    ROLLED_BACK,
    STOPPED,
    Outcome,
    Promotion,
    Terms,
)
from rlservo.client.promotion_evidence import OUTCOMES, PromotionLimits
from rlservo.client.promotion_log import PromotionLog
from rlservo.drive.control_loop import rollout
from rlservo.errors import ObservationError, UsageError
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.server.api_keys import Keys, new_key
from rlservo.serve_app.server.request_handler import RequestHandler
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.plan_follower import PlanFollower
from servers import over_uvicorn

KEY, LINE = new_key("boss", admin=True)
SETTINGS = ServerSettings(operator_key=LINE.split()[-1])
OBS = [0.5] * 27
EVERY_S = 10.0
CONFIG = {"policies": {"ur5": {"aliases": {"production": "1"}}}}


@dataclass
class Server:
    """A server with ur5 in 1, 2 (the same network), 3 (its actions leave the space) and 4 (another network)."""

    control: PlanFollower
    port: int = 0
    replica: str = "only"
    app: Any = None
    lie: Callable[[str], str | None] | None = None
    """Changes the metrics on their way to the promotion; None is no answer."""
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def restart(self) -> None:
        """Count from zero, as a new process."""
        control = self.control
        self.app = create_app(control, SETTINGS, replica=self.replica)

    @property
    def handler(self) -> RequestHandler:
        handler: RequestHandler = self.app.handler
        return handler

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer as the application, and lie."""
        if self.lie is None or scope.get("path") != "/metrics":
            await self.app(scope, receive, send)
            return
        messages: list[Any] = []

        async def keep(message: Any) -> None:
            messages.append(message)

        await self.app(scope, receive, keep)
        start, *bodies = messages
        text = self.lie(b"".join(body.get("body", b"") for body in bodies).decode())
        if text is None:
            start, text = {**start, "status": 503}, '{"error": "not now", "code": "unavailable"}'
        start["headers"] = [(name, value) for name, value in start["headers"] if name != b"content-length"]
        await send(start)
        await send({"type": "http.response.body", "body": text.encode()})

    @contextmanager
    def admin(self) -> Iterator[AdminClient]:
        with AdminClient(f"http://127.0.0.1:{self.port}", api_key=KEY) as client:
            yield client

    @property
    def plan(self) -> Any:
        assert self.control.plan is not None
        return self.control.plan.policies["ur5"]

    @property
    def state(self) -> tuple[Any, ...]:
        """Production, canary and shadow."""
        canary = self.plan.canary
        return self.plan.default, canary and (canary.version, canary.share), self.plan.shadow

    def ask(self, requests: int, **fields: Any) -> None:
        """Ask so often, each time as another session."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        for _ in range(requests):
            headers = {"content-type": "application/json", "x-session-id": f"cell-{next(self.numbers)}"}
            connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS, **fields}), headers)
            connection.getresponse().read()
            while self.handler.shadows.waiting.qsize() > 30:  # more would be left out on a busy machine
                time.sleep(0.01)
        connection.close()
        while not self.handler.shadows.waiting.empty():
            time.sleep(0.01)

    def failed(self, version: str, code: str) -> int:
        return self.handler.metrics.failures.get(("ur5", version, "json", code), 0)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    root = tmp_path_factory.mktemp("promotion")
    for version, seed, scale in (("1", 0, 1.0), ("2", 0, 1.0), ("3", 0, 400.0), ("4", 7, 1.0)):
        write_box_policy(root, version=version, seed=seed, action_scale=scale)
    with controlled(root, config=CONFIG) as control:
        server = Server(control)
        server.restart()
        with over_uvicorn(server) as server.port:
            yield server


@pytest.fixture
def server(running: Server) -> Server:
    running.lie = None
    with running.admin() as admin:
        for version in ("1", "2", "3", "4"):
            admin.load("ur5", version)
        admin.canary("ur5", None)
        admin.shadow("ur5", None)
        admin.alias("ur5", "production", "1")
    return running


@pytest.fixture
def other(server: Server) -> Iterator[Server]:
    """A second server that follows the same plan."""
    second = Server(server.control, replica="other")
    second.restart()
    with over_uvicorn(second) as second.port:
        yield second


@dataclass
class Run:
    """A promotion whose time passes as it sleeps; `steps` is what happens then, one after the other."""

    server: Server
    log: Path
    terms: Terms
    said: list[str] = field(default_factory=list)
    now: float = 0.0

    def __call__(self, *steps: Callable[[], object]) -> Outcome:
        waiting = iter(steps)

        def sleep(seconds: float) -> None:
            step = next(waiting, None)
            if step is not None:
                step()
            self.now += seconds

        connect = partial(AdminClient, api_key=KEY)
        with PromotionLog.open(self.log) as log:
            return Promotion(
                connect, self.terms, log, every_s=EVERY_S, say=self.said.append, sleep=sleep, clock=lambda: self.now
            ).run()

    @property
    def entries(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.log.read_text().splitlines() if line.endswith("}")]

    def events(self) -> list[str]:
        return [entry["event"] for entry in self.entries]

    def answered(self, version: str) -> float:
        """Answers of a version in the last check."""
        check = next(entry for entry in reversed(self.entries) if entry["event"] == "check")
        return float(check["counts"]["total"].get(f"{OUTCOMES}/{version}/ok", 0))


@pytest.fixture
def run(server: Server, tmp_path: Path) -> Callable[..., Run]:
    def make(
        version: str = "2", *servers: Server, share: float = 0.5, seconds: float = 3 * EVERY_S, **given: Any
    ) -> Run:
        limits = PromotionLimits(**({"error_rate": 0.05} | {"min_requests": 20} | given))
        urls = tuple(f"http://127.0.0.1:{each.port}" for each in (server, *servers))
        return Run(server, tmp_path / "log.jsonl", Terms(urls, "ur5", version, share, seconds, limits))

    return make


def test_a_good_canary_is_promoted_and_the_log_has_its_figures(run: Any, server: Server) -> None:
    promotion = run(error_rate=0.01, p99_s=1.0, action_difference=0.05)
    seen: list[Any] = []

    def step() -> None:
        seen.append(server.state)
        server.ask(110)

    outcome = promotion(step, step, step)
    assert outcome.outcome == PROMOTED, outcome
    assert seen[0] == ("1", ("2", 0.5), "2")
    assert server.state == ("2", None, None)
    assert outcome.why.endswith("2 is in production, with no canary")
    assert promotion.events() == ["start", "check", "check", "check", "decision", "end"]
    assert 100 < promotion.answered("2") < 230 and promotion.answered("1") + promotion.answered("2") == 330
    errors, slow, apart = promotion.entries[-3]["figures"]
    assert errors.startswith(f"failed requests: 0 of {promotion.answered('2'):.0f}, 0%")
    assert slow.startswith("requests above 1000 ms: 0 of") and apart.startswith("actions more than 0.05 apart: 0 of")
    with server.admin() as admin:  # a way back is kept
        assert admin.rollback("ur5", "production")["default"] == "1"


def test_a_bad_canary_is_rolled_back_long_before_the_time_is_over(run: Any, server: Server) -> None:
    promotion = run("3", seconds=1000 * EVERY_S)
    outcome = promotion(lambda: server.ask(20))
    assert outcome.outcome == ROLLED_BACK and "unsafe-action" in outcome.why, outcome
    assert server.state == ("1", None, None) and promotion.now == EVERY_S
    assert server.failed("3", "unsafe-action") >= 3 and server.failed("1", "unsafe-action") == 0


def test_a_slow_canary_is_rolled_back(run: Any, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Policy.step

    def dawdle(policy: Policy, *given: Any, **named: Any) -> Any:
        time.sleep(0.03 * (policy.contract.version == "2"))
        return step(policy, *given, **named)

    monkeypatch.setattr(Policy, "step", dawdle)
    outcome = run(error_rate=None, p99_s=0.02, seconds=1000 * EVERY_S)(lambda: server.ask(20))
    assert outcome.outcome == ROLLED_BACK and "requests above 20 ms" in outcome.why, outcome


def test_actions_that_differ_roll_back(run: Any, server: Server) -> None:
    outcome = run("4", error_rate=None, action_difference=0.05)(lambda: server.ask(120), lambda: server.ask(1))
    assert outcome.outcome == ROLLED_BACK and "actions more than 0.05 apart" in outcome.why, outcome
    assert server.state == ("1", None, None)


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


def test_success_is_compared_by_the_ends_that_rollouts_report(run: Any, server: Server) -> None:
    assert server.control.store is not None
    wanted = server.control.store.get("ur5", "1").act(np.array(OBS, np.float32))
    register("Promoted-v0", lambda: Reach(wanted))

    def episodes() -> None:
        with PolicyClient(f"http://127.0.0.1:{server.port}", "ur5") as client:
            rollout(client, "Promoted-v0", episodes=150)

    try:
        outcome = run("4", error_rate=None, success_drop=0.02)(episodes)
    finally:
        del registry["Promoted-v0"]
    assert outcome.outcome == ROLLED_BACK and "episodes without success (in production 0 of" in outcome.why, outcome
    assert server.state == ("1", None, None)


def test_ends_of_sessions_that_chance_sends_anywhere_are_not_counted(server: Server) -> None:
    with server.admin() as admin:
        admin.canary("ur5", "2", 0.5)
    for version, expected in ((None, 0), ("2", 1)):
        before = sum(server.handler.metrics.ends.values())
        path = "act" if version is None else f"versions/{version}/act"
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        document = json.dumps({"obs": OBS, "final_status": "success"})
        connection.request("POST", f"/v1/policies/ur5/{path}", document, {"content-type": "application/json"})
        assert connection.getresponse().status == 200
        connection.close()
        assert sum(server.handler.metrics.ends.values()) - before == expected


@pytest.mark.parametrize(
    ("limits", "requests", "says"),
    [
        ({"error_rate": 0.01}, 10, "100 needed"),
        ({"error_rate": 0.01, "min_requests": 3}, 10, "100 needed for a limit of 1%, whatever --min-requests)"),
        ({"error_rate": 0.001}, 200, "1,000 needed"),
        ({"success_drop": 0.02}, 200, "20 of each version needed"),
        ({"action_difference": 1.0, "min_requests": 500}, 200, "500 needed"),
    ],
)
def test_too_little_is_not_promoted(run: Any, server: Server, limits: Any, requests: int, says: str) -> None:
    outcome = run(**limits)(lambda: server.ask(requests))
    assert outcome.outcome == ROLLED_BACK and says in outcome.why, outcome
    assert server.state == ("1", None, None)


# Failures that are the canary's own, and others.


def test_a_failure_of_a_canary_drawn_by_chance_is_its_own(server: Server) -> None:
    before = server.failed("3", "unsafe-action"), server.failed("1", "unsafe-action")
    with server.admin() as admin:
        admin.canary("ur5", "3", 1.0)
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("POST", "/v1/policies/ur5/act", json.dumps({"obs": OBS}), {"content-type": "application/json"})
    assert connection.getresponse().status == 500
    connection.close()
    assert (server.failed("3", "unsafe-action"), server.failed("1", "unsafe-action")) == (before[0] + 1, before[1])


def test_a_bug_in_a_canary_is_its_own(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    with server.admin() as admin:
        admin.canary("ur5", "2", 1.0)
    failed = server.failed("2", "internal")
    monkeypatch.setattr(Policy, "step", lambda *_, **__: 1 / 0)
    server.ask(3)
    assert server.failed("2", "internal") == failed + 3


def test_what_robots_send_wrong_is_not_the_canarys(run: Any, server: Server) -> None:
    failed = server.failed("2", "bad-observation")

    def ask_wrongly() -> None:
        server.ask(20, obs=OBS[1:])
        server.ask(20, obs=[*OBS[1:], math.nan])
        server.ask(20, obs=OBS, no_such_field=1)

    outcome = run("2", share=1.0)(lambda: server.ask(40), ask_wrongly)
    assert outcome.outcome == PROMOTED, outcome
    assert server.failed("2", "bad-observation") >= failed + 20  # it is counted, and not held against it


def test_a_canary_whose_computing_makes_requests_late_is_rolled_back(run: Any, server: Server) -> None:
    outcome = run("2", share=0.1)(lambda: server.ask(300), lambda: server.ask(100, obs=OBS, deadline_ms=1e-6))
    assert outcome.outcome == ROLLED_BACK and "requests of all versions that waited too long: 100 of 400" in outcome.why


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
    assert outcome.outcome == ROLLED_BACK and "failed requests (stricter-than-production)" in outcome.why, outcome


# Other operators.


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
        (alias, "production is 4 and no longer 1", ("4", None)),
        (alias_to_ours, "production is 2 and no longer 1", ("2", None)),
        (other_share, "the canary is 2=0.9 and no longer 2=0.5", ("1", ("2", 0.9))),
        (other_canary, "the canary is 4=0.5 and no longer 2=0.5", ("1", ("4", 0.5))),
        (no_canary, "the canary is none and no longer 2=0.5", ("1", None)),
        (unload_version, "the canary is none and no longer 2=0.5", ("1", None)),
        (no_shadow, "the shadow is none and no longer 2", ("1", None)),
    ],
)
def test_a_change_of_another_operator_stops_it_and_is_left_as_it_is(
    run: Any, server: Server, sabotage: Callable[[AdminClient], None], says: str, left: Any
) -> None:
    def step() -> None:
        server.ask(60)
        with server.admin() as admin:
            sabotage(admin)

    outcome = run(action_difference=1.0)(step)
    assert outcome.outcome == STOPPED and says in outcome.why and "the last change was" in outcome.why, outcome
    assert server.state == (*left, None)


def test_a_policy_that_is_unloaded_stops_it(run: Any, server: Server) -> None:
    def step() -> None:
        with server.admin() as admin:
            admin.unload("ur5")

    outcome = run()(step)
    assert outcome.outcome == STOPPED and "'ur5' is no longer served" in outcome.why


def test_an_alias_that_is_moved_in_the_last_moment_is_not_moved_back(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = AdminClient.command

    def race(self: AdminClient, name: str, command: str, document: Any) -> Any:  # after the last look
        if command == "alias":
            with server.admin() as admin:
                send(admin, name, command, {"alias": "production", "version": "4"})
        return send(self, name, command, document)

    monkeypatch.setattr(AdminClient, "command", race)
    outcome = run()(lambda: server.ask(200))
    assert outcome.outcome == STOPPED and "points to 4, but was expected to point to 1" in outcome.why, outcome
    assert server.state == ("4", None, None)


def test_a_log_tells_whether_a_promotion_has_begun(tmp_path: Path) -> None:
    for _ in range(2):
        with PromotionLog.open(tmp_path / "log.jsonl") as log:
            assert not log.has_begun
            log.write("start", {})
            assert log.has_begun
            log.write("end", {})


@pytest.mark.parametrize(
    ("version", "says"),
    [("9", "has no version 9: expected one of 1, 2, 3, 4"), ("1", "already in production")],
)
def test_what_cannot_be_promoted_is_refused_before_anything_is_changed(
    run: Any, server: Server, version: str, says: str
) -> None:
    before, promotion = server.control.plan, run(version)
    with pytest.raises(UsageError, match=says):
        promotion()
    assert server.control.plan is before and not promotion.log.exists()


def test_a_policy_that_is_not_served_is_refused_by_its_name(run: Any, server: Server) -> None:
    promotion = run()
    promotion.terms = replace(promotion.terms, policy="mir")
    with pytest.raises(UsageError, match="policy 'mir' is not served; 'rlservo policy load mir 2' loads it"):
        promotion()


def test_a_canary_or_shadow_of_another_operator_is_in_the_way(run: Any, server: Server) -> None:
    with server.admin() as admin:
        admin.shadow("ur5", "4")
        with pytest.raises(UsageError, match="already has a shadow, 4"):
            run(action_difference=0.05)()
        admin.canary("ur5", "2", 0.5)
    with pytest.raises(UsageError, match=r"already has a canary, 2=0\.5"):
        run()()
    assert server.state == ("1", ("2", 0.5), "4")


# Metrics that lie, or are unreachable.


def halved(text: str) -> str:
    return re.sub(r'(requests_total\{code="ok",.*version="2"\}) (\S+)', lambda m: f"{m[1]} {float(m[2]) // 2}", text)


LIES: dict[str, Callable[[str], str | None]] = {
    "fell by": halved,
    "went up, and was never timed": lambda text: re.sub(r'(\{code="ok",.*version="2"\}) \S+', r"\1 1e9", text),
    "is not a number": lambda text: re.sub(r'(\{code="ok",.*version="2"\}) \S+', r"\1 NaN", text),
    "cannot be read": lambda text: text.replace('{code="ok"', '{code="ok'),
}


@pytest.mark.parametrize("lie", LIES)
def test_metrics_that_lie_roll_back(run: Any, server: Server, lie: str) -> None:
    def sabotage() -> None:
        server.ask(200)
        server.lie = LIES[lie]

    outcome = run()(lambda: server.ask(200), sabotage)
    assert outcome.outcome == ROLLED_BACK, outcome
    assert server.state == ("1", None, None)


def test_a_server_that_is_restarted_counts_from_zero_and_rolls_back(run: Any, server: Server) -> None:
    outcome = run()(lambda: server.ask(200), server.restart)
    assert outcome.outcome == ROLLED_BACK and " only' has started again while version 2 was on trial" in outcome.why, (
        outcome
    )
    assert server.state == ("1", None, None)


GONE: dict[str, Callable[[str], str | None]] = {
    "not now": lambda _: None,
    "no series for policy 'ur5'": lambda _: "",
    "has not loaded version 2": lambda text: re.sub(r"rlservo_policy_loaded\{.*\n", "", text),
    "follows plan 0, not yet": lambda text: re.sub(r"rlservo_plan_generation\{.*\n", "", text),
}


@pytest.mark.parametrize("what", GONE)
def test_what_cannot_be_judged_for_a_minute_is_rolled_back(run: Any, server: Server, what: str) -> None:
    def leave() -> None:
        server.ask(200)
        server.lie = GONE[what]

    promotion = run(seconds=4 * EVERY_S)
    outcome = promotion(leave)
    assert outcome.outcome == ROLLED_BACK and what in outcome.why and "60 s" in outcome.why, outcome
    assert sum(what in line for line in promotion.said) >= 5
    assert server.state == ("1", None, None)


@pytest.mark.parametrize("what", GONE)
def test_a_short_silence_costs_nothing(run: Any, server: Server, what: str) -> None:
    def leave() -> None:
        server.ask(200)
        server.lie = GONE[what]

    def come_back() -> None:
        server.lie = None

    assert run(seconds=6 * EVERY_S)(leave, lambda: None, come_back).outcome == PROMOTED


@pytest.mark.parametrize("taken", [0, 2])
def test_a_copy_of_old_metrics_is_no_evidence(run: Any, server: Server, taken: int) -> None:
    """As a cache in between would answer, from before the canary or from a while after it began."""
    texts: list[str] = []

    def copy(text: str) -> str:
        texts.append(text)
        return texts[min(taken, len(texts) - 1)]

    server.lie = copy
    outcome = run(seconds=30 * EVERY_S)(*[lambda: server.ask(100)] * 3)
    assert outcome.outcome == ROLLED_BACK and "still those of the last check" in outcome.why, outcome


def test_all_servers_that_are_named_count(run: Any, server: Server, other: Server) -> None:
    promotion = run("2", other)

    def ask() -> None:
        server.ask(50)
        other.ask(70)

    assert promotion(ask).outcome == PROMOTED
    assert promotion.answered("1") + promotion.answered("2") == 120


def test_one_bad_server_of_several_rolls_back(run: Any, server: Server, other: Server) -> None:
    def leave() -> None:
        server.ask(200)
        other.lie = GONE["has not loaded version 2"]

    outcome = run("2", other)(leave)
    assert outcome.outcome == ROLLED_BACK and f":{other.port} other' has not loaded version 2" in outcome.why, outcome


def test_a_key_that_is_revoked_leaves_it_unfinished_and_the_way_on_is_said(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = ServerSettings(operator_key=new_key("another", admin=True)[1].split()[-1])

    def revoke() -> None:
        server.ask(200)
        monkeypatch.setattr(server.handler.keys, "accepted", Keys.from_settings(others))

    promotion = run()
    outcome = promotion(revoke)
    assert outcome.outcome == STOPPED and not outcome.is_finished
    assert "could not be carried out" in outcome.why and "'rlservo policy canary ur5 off' ends" in outcome.why
    assert server.state == ("1", ("2", 0.5), None)
    monkeypatch.undo()
    outcome = promotion()
    assert outcome.outcome == PROMOTED and outcome.is_finished and server.state == ("2", None, None)


def test_a_server_that_ends_leaves_it_unfinished_and_the_way_on_is_said(
    run: Any, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a minute in which it cannot be judged, and another in which it cannot be rolled back."""
    with ExitStack() as ends:
        monkeypatch.setattr(server, "port", ends.enter_context(over_uvicorn(server)))
        promotion = run(seconds=600.0)

        def end() -> None:
            server.ask(30)
            ends.close()

        outcome = promotion(end)
    assert outcome.outcome == STOPPED and not outcome.is_finished
    assert "could not be judged for 60 s" in outcome.why and "'rlservo policy canary ur5 off'" in outcome.why, outcome
    assert "end" not in promotion.events()


# The log, and promotions resumed from it.


def kill() -> None:
    raise SystemExit(143)


def test_killed_half_way_it_goes_on_with_what_was_counted(run: Any, server: Server) -> None:
    promotion = run(seconds=3600.0)
    with pytest.raises(SystemExit):
        promotion(lambda: server.ask(60), kill)
    assert server.plan.canary.version == "2" and "end" not in promotion.events()
    assert promotion.answered("1") + promotion.answered("2") == 60
    server.ask(50)  # meanwhile
    with promotion.log.open("a") as torn:
        torn.write('{"time": "2026-')  # it was killed while it wrote
    again = replace(promotion, now=0.0, said=[])

    def end_of_time() -> None:
        server.ask(90)
        again.now += 3600

    outcome = again(end_of_time)
    assert outcome.outcome == PROMOTED, outcome
    assert any("continuing" in line for line in again.said)
    assert again.answered("1") + again.answered("2") == 200
    assert server.state == ("2", None, None)


def test_killed_between_the_decision_and_its_end_it_is_carried_out(run: Any, server: Server) -> None:
    promotion = run()
    with pytest.raises(Killed), killed_at(lambda moments: moments[-1].startswith("before alias")):
        promotion(lambda: server.ask(200))
    assert promotion.events()[-1] == "decision" and server.state == ("1", ("2", 0.5), None)
    outcome = promotion()
    assert outcome.outcome == PROMOTED and server.state == ("2", None, None)
    assert promotion.events()[-1] == "end"


class Killed(BaseException):
    """An end that no handler sees, as SIGKILL."""


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
        patch.setattr(PromotionLog, "write", dying(PromotionLog.write, lambda _, event, __: f"'{event}' is written"))
        patch.setattr(AdminClient, "command", dying(AdminClient.command, lambda _, n, command, d: f"{command} {d}"))
        yield moments


def test_killed_at_any_moment_and_started_again_it_ends_what_it_began(run: Any, server: Server) -> None:
    """Killed before its canary runs it only cleans up; after that it is carried out once."""
    for number in itertools.count():
        promotion = run(error_rate=0.2, action_difference=1.0, seconds=2 * EVERY_S, share=0.3)
        try:
            with killed_at(lambda moments, most=number: len(moments) > most) as moments:  # type: ignore[misc]
                promotion(lambda: server.ask(200))
        except Killed:
            moment = moments[-1]
        else:
            break
        is_begun = any(each.startswith("after 'start'") for each in moments)
        is_running = any(each.startswith("after canary") for each in moments)
        try:
            outcome = promotion(lambda: server.ask(200))
        except UsageError as error:
            assert moment == "after 'end' is written" and "already in production" in error.message
        else:
            expected = PROMOTED if is_running or not is_begun else STOPPED
            assert (outcome.outcome, outcome.is_finished) == (expected, True), (moment, outcome)
            assert server.state == ("2" if expected == PROMOTED else "1", None, None), moment
        assert promotion.events().count("end") == 1
        promotion.log.unlink()
        with server.admin() as admin:
            admin.alias("ur5", "production", "1")
    assert number >= 20 and promotion.events()[-1] == "end"


def test_a_promotion_that_was_undone_is_not_done_again(run: Any, server: Server) -> None:
    promotion = run()
    with pytest.raises(Killed), killed_at(lambda moments: moments[-1].startswith("after alias")):
        promotion(lambda: server.ask(200))
    assert server.plan.default == "2"
    with server.admin() as admin:
        admin.rollback("ur5", "production")
    outcome = promotion()
    assert (
        outcome.outcome == STOPPED
        and outcome.is_finished
        and "may have undone this promotion (the last change" in outcome.why
    )
    assert server.state == ("1", None, None)


def test_other_terms_do_not_go_on_with_it_and_a_second_process_waits_for_the_first(run: Any, server: Server) -> None:
    promotion = run()
    with pytest.raises(SystemExit):
        promotion(kill)
    with pytest.raises(UsageError, match="has an unfinished promotion with other terms"):
        run(share=0.4)()
    whole = promotion.log.read_text()
    promotion.log.write_text(whole.replace('"seen"', '"saw"'))
    with pytest.raises(UsageError, match="cannot be read"):
        promotion()
    promotion.log.write_text(whole)
    with (
        PromotionLog.open(promotion.log),
        pytest.raises(UsageError, match="another 'rlservo policy promote' is writing"),
    ):
        promotion()
    assert server.plan.canary is not None


def test_ctrl_c_rolls_back(run: Any, server: Server) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    outcome = run()(lambda: server.ask(200), interrupt)
    assert outcome.outcome == INTERRUPTED and outcome.why.endswith("1 is in production, with no canary")
    assert server.state == ("1", None, None)


@pytest.mark.parametrize("content", ["hello\n", '{"a": 1}\n', "[1]\n"])
def test_a_file_that_is_no_log_is_not_written_to(tmp_path: Path, content: str) -> None:
    file = tmp_path / "notes"
    file.write_text(content)
    with pytest.raises(UsageError, match="is not a promotion's log"), PromotionLog.open(file):
        pass
    assert file.read_text() == content


@pytest.mark.parametrize("entry", ["start", "check", "decision", "end"])
def test_a_log_that_cannot_be_written_is_a_sentence_and_promotes_nothing(
    run: Any, server: Server, entry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, is_full = os.fsync, [False]

    def fsync(file: Any) -> None:
        descriptor = file if isinstance(file, int) else file.fileno()
        last = run().log.read_text().splitlines()[-1]
        is_full[0] |= f'"event": "{entry}"' in last
        if is_full[0] and os.path.samestat(os.fstat(descriptor), run().log.stat()):  # not the server's plan
            raise OSError(errno.ENOSPC, "No space left on device")
        written(descriptor)

    promotion = run()
    monkeypatch.setattr("rlservo.client.promotion_log.os.fsync", fsync)
    says = r"the log .*log\.jsonl cannot be written: No space left on device"
    if entry == "start":
        with pytest.raises(UsageError, match=says):
            promotion(lambda: server.ask(200))
    else:
        outcome = promotion(lambda: server.ask(200))
        assert outcome.outcome == (PROMOTED if entry == "end" else STOPPED), outcome
        assert re.search(says, " ".join([outcome.why, *promotion.said]))
    assert server.state == ("2" if entry == "end" else "1", None, None)


@pytest.mark.parametrize(("jump_s", "left"), [(-1e9, "20 s are left"), (1e9, "0 s are left")])
def test_a_clock_that_was_set_meanwhile_adds_no_time(
    run: Any, server: Server, jump_s: float, left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    promotion = run(seconds=3 * EVERY_S)
    with pytest.raises(SystemExit):
        promotion(lambda: server.ask(20), kill)
    promotion.now = 0.0
    now = time.time
    monkeypatch.setattr("rlservo.client.promotion.time.time", lambda: now() + jump_s)
    steps = [lambda: server.ask(60 if jump_s < 0 else 0), *[lambda: None] * 9]
    outcome = promotion(*steps, lambda: pytest.fail("it goes on indefinitely"))
    assert any(f"continuing: {left}" in line for line in promotion.said), promotion.said
    assert outcome.outcome == (PROMOTED if jump_s < 0 else ROLLED_BACK) and server.plan.canary is None


@dataclass
class Balanced:
    """A load balancer: each look at the metrics is answered by the next of the replicas, as on Ray."""

    replicas: list[Server]
    looks: Iterator[int] = field(default_factory=itertools.count)

    @property
    def handler(self) -> RequestHandler:
        return self.replicas[0].handler

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        is_look = scope.get("path") == "/metrics"
        replica = self.replicas[next(self.looks) % len(self.replicas) if is_look else 0]
        await replica.app(scope, receive, send)


@pytest.fixture
def balanced(server: Server) -> Balanced:
    """Three replicas, the first of which serves."""
    replicas = [Server(server.control, replica=name) for name in ("first", "second", "third")]
    for replica in replicas:
        replica.restart()
    server.app = Balanced(replicas)
    return server.app


def test_a_replica_that_joins_is_no_evidence(run: Any, server: Server, balanced: Balanced) -> None:
    joining = balanced.replicas.pop()

    def join() -> None:
        joining.restart()
        balanced.replicas.append(joining)

    outcome = run()(lambda: server.ask(60), join, *[lambda: server.ask(60)] * 4)
    assert outcome.outcome == PROMOTED, outcome


def test_a_replica_that_vanishes_is_evidence(run: Any, server: Server, balanced: Balanced) -> None:
    outcome = run()(lambda: server.ask(60), balanced.replicas.pop, lambda: server.ask(60))
    assert outcome.outcome == ROLLED_BACK and "third' has vanished while version 2 was on trial" in outcome.why, outcome


def test_a_replica_that_another_one_replaces_is_evidence(run: Any, server: Server, balanced: Balanced) -> None:
    replacing = Server(server.control, replica="fourth")

    def replace_the_second() -> None:
        replacing.restart()
        balanced.replicas[1] = replacing

    outcome = run()(lambda: server.ask(60), replace_the_second, lambda: server.ask(60))
    assert outcome.outcome == ROLLED_BACK and "second' has vanished" in outcome.why, outcome


def test_a_replica_that_starts_again_under_its_name_is_evidence(run: Any, server: Server, balanced: Balanced) -> None:
    outcome = run()(lambda: server.ask(60), balanced.replicas[2].restart, lambda: server.ask(60))
    assert outcome.outcome == ROLLED_BACK and "third' has started again while version 2 was on trial" in outcome.why


def test_a_replica_that_joined_and_vanishes_is_evidence(run: Any, server: Server, balanced: Balanced) -> None:
    joining = balanced.replicas.pop()

    def join() -> None:
        joining.restart()
        balanced.replicas.append(joining)

    outcome = run(seconds=8 * EVERY_S)(
        join, *[lambda: server.ask(60)] * 3, balanced.replicas.pop, lambda: server.ask(60)
    )
    assert outcome.outcome == ROLLED_BACK and "third' has vanished" in outcome.why, outcome
