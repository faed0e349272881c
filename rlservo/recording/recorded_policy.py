"""A policy whose decisions are recorded: in process, over HTTP, over a WebSocket, with or without a fallback."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rlservo.bundle.contract import Contract
from rlservo.errors import RlservoError
from rlservo.policy.acting_policy import ActingPolicy, Observation
from rlservo.recording.policy_format import PolicyFormat
from rlservo.recording.recorder import Recorder
from rlservo.recording.records import DecisionRecord, OutcomeRecord


class WithRecording(ActingPolicy):
    """A policy that records its observations and actions; `outcome` adds rewards and episode ends.

    ```python
    with WithRecording(Policy.load("policies/ur5"), "run.mcap") as policy:
        policy.reset()
        action = policy.act(obs)
        obs, reward, terminated, truncated, info = env.step(action)
        policy.outcome(reward, terminated=terminated, truncated=truncated, final_obs=obs)
    ```

    It records the episodes of one loop: each loop needs its own policy; they may share a Recorder.
    """

    def __init__(
        self,
        policy: ActingPolicy,
        record: str | Path | Recorder,
        *,
        wait: bool = False,
        act: Callable[..., Any] | None = None,
    ) -> None:
        """Record to the new file `record` (.mcap), into the folder `record`, or with an existing Recorder.

        `wait` is the Recorder's; `act` replaces `policy.act` for a policy that records itself.
        """
        self._policy = policy
        self._act = policy.act if act is None else act
        self._own = None if isinstance(record, Recorder) else Recorder(record, wait=wait)
        self._recorder = record if isinstance(record, Recorder) else self._own
        self._source = _innermost(policy)
        self._format: PolicyFormat | None = None
        self._format_contract: Contract | None = None
        self._episode = ""
        self._step = 0
        self.robot: Mapping[str, Any] | None = None
        """State of a real robot for the next outcome; the control loop sets it from `info`."""
        self.begin()

    @property
    def policy(self) -> ActingPolicy:
        """The recorded policy."""
        return self._policy

    @property
    def contract(self) -> Contract:
        return self._policy.contract

    @property
    def recorder(self) -> Recorder:
        """Recorder of the decisions."""
        assert self._recorder is not None
        return self._recorder

    def act(
        self, obs: Observation, *, explore: bool = False, seed: int | None = None, reward: ArrayLike | None = None
    ) -> Any:
        """Return the policy's action and record it; its exceptions are recorded and raised."""
        seen = _copy(obs)  # an environment may overwrite its observation later
        more: dict[str, Any] = {} if reward is None else {"reward": reward}
        wall_ns, monotonic_ns, began = time.time_ns(), time.monotonic_ns(), time.perf_counter()
        action, error = None, None
        try:
            action = self._act(obs, explore=explore, seed=seed, **more)
        except RlservoError as raised:
            error = raised.code
            raise
        finally:
            latency_ms = 1e3 * (time.perf_counter() - began)
            policy = self._known_format(action is not None)
            if policy is not None:
                record = DecisionRecord(
                    policy, seen, _copy(action), self._episode, self._step, latency_ms, explore,
                    reward_input=reward, error=error, rows=policy.observations.count_rows(seen), wall_ns=wall_ns,
                    monotonic_ns=monotonic_ns,
                )  # fmt: skip
                self._add_details(record)
                self.recorder.record(record)
            self._step += 1
        return action

    def outcome(
        self,
        reward: float | None = None,
        *,
        terminated: bool = False,
        truncated: bool = False,
        final_status: str | None = None,
        final_obs: Observation | None = None,
    ) -> None:
        """Record the last action's reward and whether the episode ended with it, and pass it on to a client.

        `final_obs` is the observation after an episode's last action. Does nothing before the first action.
        """
        brought: dict[str, Any] = {
            "terminated": terminated, "truncated": truncated, "final_status": final_status, "final_obs": final_obs
        }  # fmt: skip
        self.record_outcome(reward, **brought)
        pass_on = getattr(self._policy, "outcome", None)
        if pass_on is not None:
            pass_on(reward, **brought)

    def record_outcome(
        self,
        reward: float | None,
        *,
        terminated: bool,
        truncated: bool,
        final_status: str | None,
        final_obs: Observation | None,
    ) -> None:
        """Record the last action's outcome, without passing it on."""
        self._add_outcome(
            reward=None if reward is None else float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            final_status=final_status,
            final_obs=None if final_obs is None else _copy(final_obs),
        )

    def set_last_action(self, action: Any) -> None:
        """Record the robot's command instead of the last action, and pass it on to a client."""
        self.record_command(action)
        pass_on = getattr(self._policy, "set_last_action", None)
        if pass_on is not None:
            pass_on(action)

    def record_command(self, action: Any) -> None:
        """Record the robot's command instead of the last action, without passing it on."""
        self._add_outcome(commanded=_copy(action))

    def begin(self) -> None:
        """Begin an episode of the recording only."""
        self._episode, self._step = uuid.uuid4().hex[:16], 0

    def end(self) -> None:
        """End only the recording; a Recorder passed in continues."""
        if self._own is not None:
            self._own.close()

    def reset(self) -> None:
        """Start an episode."""
        self.begin()
        self._policy.reset()

    def close(self) -> None:
        """End the recording and close the policy."""
        self.end()
        self._policy.close()

    def _known_format(self, has_acted: bool) -> PolicyFormat | None:
        """Return the policy's format; None before a server has sent its contract."""
        if has_acted and (self._format is None or self._policy.contract is not self._format_contract):
            self._format_contract = self._policy.contract  # for a client, another version may answer by now
            options = getattr(self._source, "options", None)
            self._format = self.recorder.policy(
                self._format_contract,
                graph_hash=getattr(self._source, "graph_hash", ""),
                options=None if options is None else options.model_dump(mode="json", exclude_defaults=True),
            )
        return self._format

    def _add_details(self, record: DecisionRecord) -> None:
        """Add the policy's details of its last action."""
        failure = getattr(self._policy, "failure", None)  # of a policy with a fallback
        if failure is not None and record.error is None:
            record.action, record.commanded, record.error = None, record.action, failure.code
        draw = getattr(self._source, "draw", None)
        if record.explore and draw is not None and record.action is not None:
            record.own_action, record.dist_inputs = draw.own, draw.inputs
        reply = getattr(self._source, "last_reply", None)  # of a client
        if isinstance(reply, Mapping) and record.action is not None:
            record.seq, record.warnings = reply.get("seq"), reply.get("warnings") or ()
        elif record.action is not None:
            record.warnings = getattr(self._source, "last_notices", ())  # of a policy in process

    def _add_outcome(self, **fields: Any) -> None:
        robot, self.robot = self.robot, None
        if self._format is not None and self._step:
            self.recorder.record(OutcomeRecord(self._format, self._episode, self._step - 1, robot=robot, **fields))


def _innermost(policy: Any) -> Any:
    """Return the policy inside all wrappers."""
    while (inner := getattr(policy, "policy", None)) is not None:
        policy = inner
    return policy


def _copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copy(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(_copy(part) for part in value)
    return None if value is None else np.array(value)
