"""Episodes assembled from a recording's messages: columns of numbers, one row per decision.

It streams: an episode is yielded when it ends, a very long one in pieces, and if too many never end, the one that was
silent longest is given up.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.recording.policy_format import PolicyFormat
from rlservo.recording.reader import Entry, Recording

LONGEST_PIECE = 10_000  # decisions
MOST_OPEN = 2_000  # episodes at a time
LOOSE_PIECE = 1_000  # decisions without an episode, at a time

Columns = dict[str, NDArray[Any]]


@dataclass
class RecordedEpisode:
    """Decisions of one episode in order, or of a piece of it, or decisions without an episode (`id` is empty)."""

    policy: PolicyFormat
    id: str
    begins: bool
    """Whether the first decision is the episode's first."""
    goes_on: bool = False
    """Whether another piece follows."""
    ended: bool = False
    """Whether the recording has its end."""
    terminated: bool = False
    truncated: bool = False
    final_status: str | None = None
    _decisions: list[dict[str, Any]] = field(default_factory=list, repr=False)
    _outcomes: list[dict[str, Any] | None] = field(default_factory=list, repr=False)
    _log_times_ns: list[int] = field(default_factory=list, repr=False)
    _wall_ns: list[int] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self._decisions)

    @cached_property
    def steps(self) -> NDArray[np.int64]:
        """Number of each decision in the episode, from 0."""
        return np.array([one["step"] for one in self._decisions], np.int64)

    @property
    def gap(self) -> int | None:
        """Return the first row before which decisions are missing; None if all are present."""
        expected = self.steps[0] + np.arange(len(self)) if self.id else self.steps
        if self.id and not self.begins and self.steps[0] == 0:
            return 0
        missing = np.flatnonzero(self.steps != expected)
        return int(missing[0]) if len(missing) else None

    @cached_property
    def time_s(self) -> NDArray[np.float64]:
        """Time of each decision [s since 1970], from a clock that never jumps."""
        return np.array(self._log_times_ns, np.float64) / 1e9

    @property
    def is_faster_than_real(self) -> bool:
        """Whether its decisions came at over twice the control rate: in a simulation at full speed."""
        rate_hz, span_s = self.policy.contract.control_rate_hz, self.time_s[-1] - self.time_s[0]
        return rate_hz is not None and bool(span_s * rate_hz * 2 < self.steps[-1] - self.steps[0])

    @cached_property
    def episode_s(self) -> NDArray[np.float64]:
        """Time of each decision since the first [s]: by the control rate in a simulation that ran at full speed."""
        rate_hz = self.policy.contract.control_rate_hz
        if rate_hz is not None and self.is_faster_than_real:
            return np.asarray((self.steps - self.steps[0]) / rate_hz, np.float64)
        return np.asarray(self.time_s - self.time_s[0], np.float64)

    @cached_property
    def wall_ns(self) -> NDArray[np.int64]:
        """The same from the wall clock [ns since 1970]."""
        return np.array(self._wall_ns, np.int64)

    @cached_property
    def obs(self) -> Columns:
        """The observations by tensor name, `[rows, *shape]`."""
        return self.policy.observations.columns([one["obs"] for one in self._decisions])

    @cached_property
    def action(self) -> Columns:
        """The actions that were sent, by tensor name; zeros if there was none (`acted`)."""
        return self.policy.actions.columns([one.get("action") for one in self._decisions])

    @cached_property
    def acted(self) -> NDArray[np.bool_]:
        """Whether the policy gave an action."""
        return np.array(["action" in one for one in self._decisions], np.bool_)

    @cached_property
    def fell_back(self) -> NDArray[np.bool_]:
        """Whether the robot got another action instead."""
        return np.array([one is not None for one in self._commands()], np.bool_)

    @cached_property
    def executed(self) -> Columns:
        """The robot's commands: the policy's actions, or their replacements."""
        commands = self._commands()
        return self.policy.actions.columns(
            [
                one.get("action") if command is None else command
                for one, command in zip(self._decisions, commands, strict=True)
            ]
        )

    @cached_property
    def explored(self) -> NDArray[np.bool_]:
        """Whether the action was drawn from the policy's distribution."""
        return np.array([one.get("explore", False) for one in self._decisions], np.bool_)

    @property
    def may_teach(self) -> bool:
        """Whether everything reported about it came with keys that may explore."""
        return all(one is None or one.get("may_teach", True) for one in self._outcomes)

    @cached_property
    def own_action(self) -> Columns:
        """The module's own actions; zeros where `logp` is not a number."""
        return self.policy.actions.columns([one.get("own_action") for one in self._decisions])

    @cached_property
    def logp(self) -> NDArray[np.float64]:
        """The log-probability of each own action; NaN if it is not known."""
        return self._numbers("logp")

    @cached_property
    def dist_inputs(self) -> NDArray[np.float32]:
        """The distribution's parameters `[rows, n]`; NaN if they are not known."""
        size = next((len(one["dist_inputs"]) for one in self._decisions if "dist_inputs" in one), 0)
        unknown = [math.nan] * size
        rows = [one.get("dist_inputs", unknown) for one in self._decisions]
        return np.array([[-math.inf if x is None else x for x in row] for row in rows], np.float32)

    @cached_property
    def reward(self) -> NDArray[np.float64]:
        """Reward of each decision; NaN if it is not known."""
        rewards = [math.nan if one is None else one.get("reward", math.nan) for one in self._outcomes]
        return np.array(rewards, np.float64)  # a null is not a number

    @cached_property
    def reward_input(self) -> NDArray[np.float64]:
        """The policy's reward input; NaN if there was none."""
        return self._numbers("reward_input")

    @cached_property
    def last_action_input(self) -> dict[int, Columns]:
        """Return each row's action `[1, *shape]` from which a step limit counted, if the client sent it."""
        key = "last_action_input"
        given = [(row, one[key]) for row, one in enumerate(self._decisions) if key in one]
        return {row: self.policy.actions.columns([action]) for row, action in given}

    @cached_property
    def latency_ms(self) -> NDArray[np.float64]:
        return self._numbers("latency_ms")

    @cached_property
    def final_obs(self) -> Columns | None:
        """The observation after the last action, `[1, *shape]`, if it was recorded."""
        last = self._outcomes[-1] if self._outcomes else None
        return (
            None if last is None or "final_obs" not in last else self.policy.observations.columns([last["final_obs"]])
        )

    @property
    def robot(self) -> list[dict[str, Any]]:
        """Return each row's report of a real robot's step (`state`, `changes`, `limited`); empty elsewhere."""
        return [{} if one is None else one.get("robot", {}) for one in self._outcomes]

    @property
    def warnings(self) -> list[tuple[int, str]]:
        """Return (row, sentence) for every warning."""
        return [(row, text) for row, one in enumerate(self._decisions) for text in one.get("warnings", ())]

    @property
    def errors(self) -> list[str | None]:
        """Return each row's reason for a missing action; None if there was an action."""
        return [one.get("error") for one in self._decisions]

    def field(self, name: str) -> list[Any]:
        """Return a field as it was recorded, such as `seq` or `request_id`; None if it is absent."""
        return [one.get(name) for one in self._decisions]

    def part(self, begin: int, end: int, *, terminated: bool) -> RecordedEpisode:
        """Return rows `begin` to `end` (exclusive) as an episode; row `end` has the observation after it."""
        rows = slice(begin, end)
        outcomes = list(self._outcomes[rows])
        if end < len(self):
            outcomes[-1] = {**(outcomes[-1] or {}), "final_obs": self._decisions[end]["obs"]}
        begins = self.begins if begin == 0 else not self.policy.contract.state  # the state was not reset there
        return RecordedEpisode(
            self.policy, self.id, begins=begins, ended=True, terminated=terminated,
            truncated=not terminated, _decisions=self._decisions[rows], _outcomes=outcomes,
            _log_times_ns=self._log_times_ns[rows], _wall_ns=self._wall_ns[rows],
        )  # fmt: skip

    def _drop_last(self) -> None:
        for rows in (self._decisions, self._outcomes, self._log_times_ns, self._wall_ns):
            rows.pop()

    def _numbers(self, name: str) -> NDArray[np.float64]:
        return np.array([one.get(name, math.nan) for one in self._decisions], np.float64)

    def _commands(self) -> list[Any]:
        return [
            one.get("commanded", None if outcome is None else outcome.get("commanded"))
            for one, outcome in zip(self._decisions, self._outcomes, strict=True)
        ]


def episodes(recording: Recording) -> Iterator[RecordedEpisode]:
    """Yield every episode of a recording as it ends, then the unfinished ones."""
    assembler = EpisodeAssembler()
    for entry in recording.entries():
        yield from assembler.add(entry)
    yield from assembler.opened.values()


class EpisodeAssembler:
    """Assembles the messages of one writer into episodes."""

    def __init__(self) -> None:
        self.opened: OrderedDict[tuple[int, str], RecordedEpisode] = OrderedDict()
        """The episodes that have not ended, by policy and id; those silent longest come first."""

    def add(self, entry: Entry) -> Iterator[RecordedEpisode]:
        """Take the next message and yield the episodes, or pieces of one, that end with it."""
        key = (id(entry.policy), str(entry.fields.get("episode", "")))
        if entry.kind == "decision":
            yield from _add_decision(self.opened, key, entry)
        elif (episode := self.opened.get(key)) is not None:
            _add_outcome(episode, entry.fields)
            if episode.ended:
                yield self.opened.pop(key)
        if len(self.opened) > MOST_OPEN:
            yield self.opened.popitem(last=False)[1]

    def give_up(self, before_ns: int) -> Iterator[RecordedEpisode]:
        """Yield and drop the open episodes whose last decision came before a log time."""
        while self.opened and next(iter(self.opened.values()))._log_times_ns[-1] < before_ns:
            yield self.opened.popitem(last=False)[1]


def _add_decision(
    opened: OrderedDict[tuple[int, str], RecordedEpisode], key: tuple[int, str], entry: Entry
) -> Iterator[RecordedEpisode]:
    episode = opened.get(key)
    step = entry.fields["step"]
    if episode is not None and key[1] and 0 < step == episode._decisions[-1]["step"]:
        episode._drop_last()  # decided again: the client did not get the first answer
    first = True
    if episode is not None:
        begins_anew = bool(key[1] and episode._decisions) and step <= episode._decisions[-1]["step"]
        full = len(episode) >= (LONGEST_PIECE if key[1] else LOOSE_PIECE)
        first = begins_anew or not key[1]
        if begins_anew or full:
            episode.goes_on = full and not begins_anew
            yield opened.pop(key)
            episode = None
    if episode is None:
        episode = opened[key] = RecordedEpisode(entry.policy, key[1], begins=first and step == 0)
    episode._decisions.append(entry.fields)
    episode._outcomes.append(None)
    episode._log_times_ns.append(entry.log_time_ns)
    episode._wall_ns.append(entry.wall_ns)
    opened.move_to_end(key)


def _add_outcome(episode: RecordedEpisode, fields: dict[str, Any]) -> None:
    """Attach an outcome to its decision: nearly always the last one."""
    for row in range(len(episode) - 1, -1, -1):
        if episode._decisions[row]["step"] == fields["step"]:
            before = episode._outcomes[row] or {}
            teaches = before.get("may_teach", True) and fields.get("may_teach", True)
            episode._outcomes[row] = {**before, **fields, "may_teach": teaches}
            break
        if episode._decisions[row]["step"] < fields["step"]:
            break
    episode.terminated |= fields.get("terminated", False)
    episode.truncated |= fields.get("truncated", False)
    episode.final_status = fields.get("final_status", episode.final_status)
    episode.ended = episode.terminated or episode.truncated or episode.final_status is not None
