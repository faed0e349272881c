"""Sessions by id over several replicas: whatever joins, drains, dies or is cut off, every action is its episode's own.

Replicas, store and network are simulated in one event loop, with delays drawn from a seed: what is sent may be lost,
or its answer, and a write that failed may be done later. Clients play episodes of a real LSTM and compare every action
with the same policy's in process.
"""

from __future__ import annotations

import asyncio
import contextlib
import pickle
import random
import secrets
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.export.contract.errors import DeadlineError, RlservoError, SessionError, SessionLostError, UnavailableError
from rlservo.serve_app.episodes.request import Episode, Request
from rlservo.serve_app.episodes.shared_sessions import SharedSessions, key_of
from rlservo.serve_app.runtime.policy import Policy
from rlservo.serve_app.server.request_path import RequestPath
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.policy_store import Decision, PolicyStore, take_step
from rlservo.serve_app.wire.request_stamp import STAMP
from stores import load_store

NAME = "lstm_box"
AT_ONCE = 10  # clients that ask
REFUSED = (RlservoError, ConnectionError, TimeoutError)  # as a request may end whose client has given up


class GivenUpError(Exception):
    """The client waits no longer for its answer."""


@dataclass
class World:
    """What replicas share, and what can happen between them."""

    policies: PolicyStore
    draw: random.Random
    lost: float = 0.0  # of what is sent
    records: dict[str, bytes] = field(default_factory=dict)
    replicas: dict[str, Replica] = field(default_factory=dict)
    dead: set[str] = field(default_factory=set)
    cut: set[frozenset[str]] = field(default_factory=set)  # pairs that do not hear each other; "" is the store
    deleted: int = 0  # records and links
    later: list[asyncio.Task[Any]] = field(default_factory=list)

    def add(self) -> Replica:
        name = secrets.token_hex(4)
        self.replicas[name] = Replica(self, name)
        return self.replicas[name]

    async def travel(self, one: str, other: str) -> None:
        """Take a while; fail where the way is cut, now or on arrival."""
        for _ in range(self.draw.randrange(4)):
            await asyncio.sleep(0)
        if frozenset((one, other)) in self.cut or self.draw.random() < self.lost:
            raise TimeoutError("nobody answers")

    def kill(self, name: str) -> None:
        self.dead.add(name)
        self.replicas.pop(name)


@dataclass
class Replica:
    world: World
    name: str

    def __post_init__(self) -> None:
        self.path = RequestPath(lambda: self.world.policies, ServerSettings(max_sessions=10_000))
        self.path.shared_sessions = SharedSessions(self.path.episodes, self, self, self.name)

    @property
    def shared(self) -> SharedSessions:
        assert self.path.shared_sessions is not None
        return self.path.shared_sessions

    async def act(self, request: Request) -> Decision:
        """Decide as the server does; a client of a replica that dies gets nothing."""
        decision = await self.path.decide(request)
        await asyncio.sleep(0)
        if self.name in self.world.dead:
            raise ConnectionError("the replica died")
        return decision

    # The store, as this replica reaches it

    async def get(self, key: str) -> bytes | None:
        await self.world.travel(self.name, "")
        found = self.world.records.get(key)
        await self.world.travel(self.name, "")
        return found

    async def put(self, key: str, value: bytes) -> None:
        await self._write(lambda: self.world.records.__setitem__(key, value))

    async def create(self, key: str, value: bytes) -> bool:
        await self._write(lambda: self.world.records.setdefault(key, value))
        return self.world.records.get(key) == value

    async def delete(self, key: str) -> None:
        self.world.deleted += key in self.world.records
        await self._write(lambda: self.world.records.pop(key, None))

    async def keys(self) -> Sequence[str]:
        await self.world.travel(self.name, "")
        return list(self.world.records)

    async def _write(self, write: Any) -> None:
        try:
            await self.world.travel(self.name, "")
        except TimeoutError:
            if self.world.draw.random() < 0.5:  # nobody hears that it is done after all
                self.world.later.append(asyncio.create_task(self._write_late(write)))
            raise
        write()
        await self.world.travel(self.name, "")

    async def _write_late(self, write: Any) -> None:
        for _ in range(self.world.draw.randrange(200)):
            await asyncio.sleep(0)
        write()

    # The other replicas, as this one reaches them

    async def call(self, replica: str, method: str, *arguments: Any) -> Any:
        await self.world.travel(self.name, replica)
        other = self.world.replicas.get(replica)
        if other is None:
            raise ProcessLookupError(replica)
        sent = pickle.loads(pickle.dumps(arguments))
        answer = await other.path.answer_peer(method, *sent)
        await self.world.travel(self.name, replica)
        if replica in self.world.dead:
            raise ProcessLookupError(replica)
        return pickle.loads(pickle.dumps(answer))

    async def running(self) -> Sequence[str]:
        return list(self.world.replicas)


@dataclass
class Client:
    """A client of one id, and what its episode must come to."""

    world: World
    session_id: str | int
    counts: bool
    seen: Counter[str]
    draw: random.Random
    state: Any = None
    last: Any = None
    steps: int = 0  # of its episode; 0: it has none
    seq: int = 0

    async def step(self) -> None:
        """Send one observation, again where the answer says so, and compare the action."""
        obs = np.asarray([self.draw.uniform(-1, 1) for _ in range(self.size)], np.float32)
        reset = self.steps == 0 or self.draw.random() < 0.05
        self.seq += 1
        for _ in range(50):
            stamp = secrets.token_hex(4).encode()
            try:
                decision = await self._send(obs, reset, stamp)
            except SessionLostError:
                self.seen["lost"] += 1
                await self._insist(obs, reset)
                self.steps = 0
                return
            except UnavailableError:  # nothing was computed, or the client counts
                self.seen["unavailable"] += 1
                continue
            except (ConnectionError, GivenUpError):  # whether it was computed nobody knows
                self.seen["broken"] += 1
                if not self.counts:
                    reset = True
                continue
            break
        else:
            self.steps = 0  # cut off for too long
            return
        if reset:
            self.state = self.last = None
            self.steps = 0
        expected, step = take_step(self.policy, obs, before=self.state, last=self.last)
        np.testing.assert_array_equal(decision.action, expected.action)
        self.state, self.last = step.state, step.leaves
        self.steps += 1
        assert decision.episode is not None and decision.episode.step == self.steps
        self.seen["right"] += 1

    async def _insist(self, obs: Any, reset: bool) -> None:
        """Go on all the same: that is refused, or where a replica could tell nobody, still of the same episode."""
        if self.draw.random() < 0.7:
            return
        try:
            decision = await self._send(obs, False, b"")
        except (SessionError, UnavailableError, ConnectionError, GivenUpError):
            self.seen["lost, and refused again"] += 1
            return
        self.seen["lost, and gone on"] += 1
        possible = []
        for state, last in ((self.state, self.last), (None, None)) if reset else ((self.state, self.last),):
            once, step = take_step(self.policy, obs, before=state, last=last)
            twice, _ = take_step(self.policy, obs, before=step.state, last=step.leaves)
            possible += [once.action, twice.action]
        assert any(np.array_equal(decision.action, each) for each in possible)

    async def _send(self, obs: Any, reset: bool, stamp: bytes) -> Decision:
        """Send through a proxy: to any replica, and to another one where that dies."""
        for retry in range(3):
            replica = self.draw.choice(list(self.world.replicas.values()))
            request = Request(
                "json", NAME, None, time.perf_counter(), obs=obs, seq=self.seq if self.counts else None,
                headers={STAMP.encode(): stamp} if stamp else {},
                episode=Episode(session_id=self.session_id, reset=reset),
            )  # fmt: skip
            try:
                return await self._wait_for(replica, request)
            except ConnectionError:
                self.seen["retried by the proxy"] += 1
            except UnavailableError:
                if not retry:
                    raise
                break  # the replica that died may have had an answer
        raise ConnectionError

    async def _wait_for(self, replica: Replica, request: Request) -> Decision:
        """Wait for an answer, or give up: the request goes on without its client, who said by when it needs it."""
        assert request.episode is not None
        answering = asyncio.create_task(replica.act(request))
        if (request.episode.reset or self.counts) and self.draw.random() < 0.1:
            for _ in range(self.draw.randrange(15)):
                await asyncio.sleep(0)
            if not answering.done():
                request.deadline_ms = 0.0
                self.world.later.append(answering)
                self.seen["given up"] += 1
                raise GivenUpError
        return await answering

    @property
    def policy(self) -> Policy:
        return self.world.policies.get(NAME)

    @property
    def size(self) -> int:
        (size,) = self.policy.contract.observation_space.shape  # type: ignore[union-attr]
        return int(size)


@pytest.fixture(scope="module")
def lstm(recurrent: Path) -> PolicyStore:
    return load_store(recurrent)


@pytest.mark.parametrize(("seed", "sessions", "steps"), [(0, 1_000, 4), (1, 100, 30), (2, 10, 200)])
def test_no_interleaving_gives_an_action_of_another_memory(
    lstm: PolicyStore, seed: int, sessions: int, steps: int
) -> None:
    world = World(lstm, random.Random(seed), lost=0.01)
    seen = asyncio.run(_play(world, sessions, steps))
    assert seen["right"] > sessions * steps / 2, seen
    harm = ["lost", "unavailable", "retried by the proxy", "given up", "handed over", "join", "kill", "cut"]
    assert world.deleted
    assert all(seen[each] > 0 for each in harm), seen


async def _play(world: World, sessions: int, steps: int) -> Counter[str]:
    seen: Counter[str] = Counter()
    for _ in range(3):
        world.add()
    ids = [number if number % 2 else str(number - 1) for number in range(sessions)]  # 7 and "7" are two
    clients = [Client(world, each, world.draw.random() < 0.5, seen, random.Random(world.draw.random())) for each in ids]

    async def play(some: list[Client]) -> None:
        for _ in range(steps * len(some)):
            await world.draw.choice(some).step()

    playing = [asyncio.create_task(play(clients[first::AT_ONCE])) for first in range(AT_ONCE)]
    harm = asyncio.create_task(_harm(world, seen, playing))
    try:
        await asyncio.gather(*playing)
    finally:
        await asyncio.gather(*playing, return_exceptions=True)
        await harm
        ends = await asyncio.gather(*world.later, return_exceptions=True)
    strange = [end for end in ends if isinstance(end, BaseException) and not isinstance(end, REFUSED)]
    assert not strange, strange
    return seen


async def _harm(world: World, seen: Counter[str], playing: Sequence[asyncio.Task[None]]) -> None:
    """Let replicas join, drain, die, be cut off from each other and from the store, and be heard again."""
    draw, sweeping = world.draw, list[asyncio.Task[None]]()
    while not all(task.done() for task in playing):
        for _ in range(draw.randint(1, 100)):
            await asyncio.sleep(0)
        names = list(world.replicas)
        kind = draw.choice(("join", "drain", "kill", "cut", "cut from the store", *["mend"] * 4, "sweep"))
        match kind:
            case "join" if len(names) < 6:
                world.add()
            case "drain" if len(names) > 2:
                leaving = world.replicas[draw.choice(names)]
                before = len(leaving.path.episodes.sessions)
                await leaving.shared.hand_over()
                seen["handed over"] += before
                for _ in range(draw.randrange(10)):  # it still answers, though nothing new is sent to it
                    await asyncio.sleep(0)
                world.kill(leaving.name)
            case "kill" if len(names) > 2:
                world.kill(draw.choice(names))
            case "cut":
                world.cut.add(frozenset(draw.sample(names, 2)))
            case "cut from the store":
                world.cut.add(frozenset((draw.choice(names), "")))
            case "mend":
                world.cut.clear()
            case "sweep":
                sweeping.append(asyncio.create_task(_sweep_twice(world, world.replicas[draw.choice(names)])))
            case _:
                continue
        seen[kind] += 1
    await asyncio.gather(*sweeping)


async def _sweep_twice(world: World, replica: Replica) -> None:
    """Look at the records twice: between the looks of a replica everything arrives that was on its way."""
    with contextlib.suppress(UnavailableError, TimeoutError):
        await replica.shared.sweep()
        await asyncio.gather(*world.later, return_exceptions=True)
        await replica.shared.sweep()


def request(session_id: str, obs: Any, *, reset: bool = False, end: bool = False, stamp: bytes = b"") -> Request:
    headers = {STAMP.encode(): stamp} if stamp else {}
    episode = Episode(session_id=session_id, reset=reset, end=end)
    return Request("json", NAME, None, time.perf_counter(), obs=obs, headers=headers, episode=episode)


@pytest.fixture
def world(lstm: PolicyStore) -> World:
    return World(lstm, random.Random(0))


@pytest.fixture
def obs(lstm: PolicyStore) -> Any:
    return np.zeros(lstm.get(NAME).contract.observation_space.shape, np.float32)  # type: ignore[union-attr]


def test_an_episode_begun_anew_elsewhere_ends_the_old_one_also_where_nobody_hears_of_it(world: World, obs: Any) -> None:
    async def run() -> None:
        old, new = world.add(), world.add()
        await old.act(request("s", obs, reset=True))
        world.cut.add(frozenset((old.name, new.name)))
        await new.act(request("s", obs, reset=True))
        with pytest.raises(SessionLostError):  # its memory is here, and of an episode that is over
            await old.act(request("s", obs))
        world.cut.clear()
        with pytest.raises(SessionLostError):  # the one who could not ask has ended it for all
            await new.act(request("s", obs))

    asyncio.run(run())


class SlowCreate:
    """A replica whose next link or record is created, or acknowledged, only when it is told so."""

    def __init__(self, replica: Replica, *, is_acknowledged_late: bool = False) -> None:
        self.arrives = asyncio.Event()
        create = replica.create

        async def create_late(key: str, value: bytes) -> bool:
            if not is_acknowledged_late:
                await self.arrives.wait()
                return await create(key, value)
            is_written = await create(key, value)
            await self.arrives.wait()
            return is_written

        replica.create = create_late  # type: ignore[method-assign]


async def others_go_on() -> None:
    for _ in range(50):
        await asyncio.sleep(0)


async def steps_are_of(replicas: Sequence[Replica], obs: Any, first: Decision, begin: Any) -> None:
    """Check that an episode begun with an observation goes on by every replica."""
    policy = replicas[0].world.policies.get(NAME)
    expected, step = take_step(policy, begin, before=None, last=None)
    np.testing.assert_array_equal(first.action, expected.action)
    for replica in replicas:
        decision = await replica.act(request("s", obs))
        expected, step = take_step(policy, obs, before=step.state, last=step.leaves)
        np.testing.assert_array_equal(decision.action, expected.action)


@pytest.mark.parametrize("has_one", [False, True])
@pytest.mark.parametrize("is_acknowledged_late", [False, True])
def test_a_reset_that_was_given_up_does_not_come_back(
    world: World, obs: Any, has_one: bool, is_acknowledged_late: bool
) -> None:
    async def run() -> None:
        slow, quick = world.add(), world.add()
        if has_one:
            await quick.act(request("s", obs, reset=True))
        late = SlowCreate(slow, is_acknowledged_late=is_acknowledged_late)
        given_up = asyncio.create_task(slow.act(request("s", obs + 0.9, reset=True)))
        await others_go_on()
        first = await quick.act(request("s", obs - 0.9, reset=True))
        late.arrives.set()
        with contextlib.suppress(UnavailableError):
            await given_up
        await steps_are_of([quick, slow], obs + 0.3, first, obs - 0.9)

    asyncio.run(run())


@pytest.mark.parametrize("by", [0, 1, 2])
def test_a_step_under_way_when_its_session_began_again_is_refused_by_every_replica(
    world: World, obs: Any, by: int
) -> None:
    async def run() -> None:
        replicas = [world.add(), world.add(), world.add()]
        await replicas[0].act(request("s", obs, reset=True))
        late = request("s", obs + 0.9)
        first = await replicas[1].act(request("s", obs - 0.9, reset=True))
        with pytest.raises(SessionError, match="of the episode before"):
            await replicas[by].act(late)
        await steps_are_of(replicas, obs + 0.3, first, obs - 0.9)

    asyncio.run(run())


def test_a_reset_held_up_while_its_record_is_swept_begins_nothing(world: World, obs: Any) -> None:
    async def run() -> None:
        slow, quick, ended = world.add(), world.add(), world.add()
        await ended.act(request("s", obs, reset=True))
        world.kill(ended.name)
        late = SlowCreate(slow)
        given_up = asyncio.create_task(slow.act(request("s", obs + 0.9, reset=True)))
        await others_go_on()
        for _ in range(2):
            await quick.shared.sweep()
        first = await quick.act(request("s", obs - 0.9, reset=True))
        late.arrives.set()
        with pytest.raises(UnavailableError, match="at the same time"):
            await given_up
        await steps_are_of([quick, slow], obs + 0.3, first, obs - 0.9)

    asyncio.run(run())


def test_a_reset_whose_deadline_passes_while_it_is_written_leaves_no_memory(world: World, obs: Any) -> None:
    async def run() -> None:
        slow = world.add()
        late = SlowCreate(slow, is_acknowledged_late=True)
        sent = request("s", obs, reset=True)
        given_up = asyncio.create_task(slow.act(sent))
        await others_go_on()
        sent.deadline_ms = 0.0
        late.arrives.set()
        with pytest.raises(DeadlineError):
            await given_up
        with pytest.raises(SessionLostError):
            await slow.act(request("s", obs))

    asyncio.run(run())


def test_a_link_that_is_the_only_way_to_an_episode_stays_until_the_record_leads_there(world: World, obs: Any) -> None:
    async def run() -> None:
        old, new = world.add(), world.add()
        await old.act(request("s", obs, reset=True))
        world.cut.add(frozenset((old.name, new.name)))
        put = new.put

        async def fail(key: str, value: bytes) -> None:
            raise TimeoutError

        new.put = fail  # type: ignore[method-assign]
        first = await new.act(request("s", obs - 0.9, reset=True))
        for _ in range(2):
            with contextlib.suppress(UnavailableError):
                await new.shared.sweep()
        world.cut.clear()
        assert len(world.records) == 2
        await steps_are_of([old, new], obs + 0.3, first, obs - 0.9)
        new.put = put  # type: ignore[method-assign]
        for _ in range(4):
            await new.shared.sweep()
        assert list(world.records) == [key_of(NAME, "s")]
        assert (await old.act(request("s", obs))).episode.step == 4  # type: ignore[union-attr]

    asyncio.run(run())


def test_a_reset_that_took_too_long_begins_nothing(world: World, obs: Any) -> None:
    async def run() -> None:
        owner = world.add()
        await owner.act(request("s", obs, reset=True))
        late = request("s", obs, reset=True)
        late.received = time.perf_counter() - 5.0
        with pytest.raises(UnavailableError, match="took longer than 4 s"):
            await owner.act(late)
        assert (await owner.act(request("s", obs))).episode.step == 2  # type: ignore[union-attr]

    asyncio.run(run())


def test_links_go_once_the_record_leads_past_them(world: World, obs: Any) -> None:
    async def run() -> None:
        one, other = world.add(), world.add()
        for replica in (one, other, one, one):
            await replica.act(request("s", obs, reset=True))
        assert len(world.records) == 4
        for _ in range(2):
            await one.shared.sweep()
            await other.shared.sweep()
        assert list(world.records) == [key_of(NAME, "s")]
        assert (await other.act(request("s", obs))).episode.step == 2  # type: ignore[union-attr]

    asyncio.run(run())


def test_a_request_sent_again_by_the_proxy_is_one_step(world: World, obs: Any) -> None:
    async def run() -> None:
        owner, one, other = world.add(), world.add(), world.add()
        await owner.act(request("s", obs, reset=True))
        first = await one.act(request("s", obs, stamp=b"1"))
        again = await other.act(request("s", obs, stamp=b"1"))
        assert first.episode is not None and again.episode is not None
        assert first.episode.step == again.episode.step == 2
        np.testing.assert_array_equal(first.action, again.action)
        assert (await owner.act(request("s", obs, stamp=b"2"))).episode.step == 3  # type: ignore[union-attr]
        with pytest.raises(SessionError, match="answered already"):
            await one.act(request("s", obs, stamp=b"1"))
        assert [each.shared.hops for each in (owner, one, other)] == [0, 2, 1]

    asyncio.run(run())


def test_without_the_store_nothing_is_computed_and_the_memory_stays(world: World, obs: Any) -> None:
    async def run() -> None:
        owner = world.add()
        await owner.act(request("s", obs, reset=True))
        world.cut.add(frozenset((owner.name, "")))
        for begins in (False, True):
            with pytest.raises(UnavailableError, match="send the 'state' along"):
                await owner.act(request("s", obs, reset=begins))
        assert owner.shared.unreachable == 2
        world.cut.clear()
        assert (await owner.act(request("s", obs))).episode.step == 2  # type: ignore[union-attr]

    asyncio.run(run())


def test_an_end_and_a_dead_owner_leave_nothing_behind(world: World, obs: Any) -> None:
    async def run() -> None:
        owner, other = world.add(), world.add()
        await owner.act(request("ended", obs, reset=True))
        await other.act(request("ended", obs, end=True))
        assert not len(owner.path.episodes.sessions)
        with pytest.raises(SessionLostError):
            await other.act(request("ended", obs))
        for _ in range(2):
            await owner.shared.sweep()
        assert not any(key_of(NAME, "ended") in key for key in world.records)
        for _ in range(2):
            await owner.shared.sweep()
        assert not world.records
        await owner.act(request("orphan", obs, reset=True))
        world.kill(owner.name)
        with pytest.raises(SessionLostError, match="no replica has the session 'orphan'"):
            await other.act(request("orphan", obs, stamp=b"1"))
        await other.shared.sweep()
        assert key_of(NAME, "orphan") in world.records  # it could be one that is just being begun
        for _ in range(3):
            await other.shared.sweep()
        assert not world.records

    asyncio.run(run())


def test_a_replica_that_ends_hands_its_episodes_over(world: World, obs: Any) -> None:
    async def run() -> None:
        owner, other = world.add(), world.add()
        await owner.act(request("s", obs, reset=True, stamp=b"1"))
        await owner.act(request("s", obs, stamp=b"2"))
        await owner.shared.hand_over()
        assert (await owner.act(request("s", obs))).episode.step == 3  # type: ignore[union-attr]
        world.kill(owner.name)
        assert (await other.act(request("s", obs, stamp=b"2"))).is_repeat
        assert (await other.act(request("s", obs, stamp=b"3"))).episode.step == 4  # type: ignore[union-attr]

    asyncio.run(run())


def test_an_id_is_only_a_label_where_nothing_is_remembered(world: World, ur5: Path) -> None:
    world.policies = load_store(ur5)
    replica = world.add()
    zeros = np.zeros(27, np.float32)
    asked = Request("json", "ur5", None, 0.0, obs=zeros, episode=Episode(session_id="s", reset=True))
    assert asyncio.run(replica.act(asked)).episode is None
    assert not world.records and asked.label == "s"
