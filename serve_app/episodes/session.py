"""Session: recurrent state of a running episode on the server, and its last answer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.errors import SessionError
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.runtime.recurrent_state import State
from rlservo.serve_app.versions.policy_store import Decision


@dataclass(slots=True)
class Session:
    """One episode, or a batch of them, of one version of a policy."""

    policy: Policy
    state: State | None = None  # None: at its start
    last: dict[str, NDArray[np.generic]] | None = None  # the last action's leaves
    steps: int = 0
    rows: int = 0  # number of episodes that it counts as
    used: float = field(default_factory=time.monotonic)
    begun: float = field(default_factory=time.perf_counter)  # number of the episode, unique for its id
    connection: Any = None  # of the last request
    seq: int | None = None  # of the last request that was answered
    inputs_hash: bytes = b""  # of its observation
    answer: Decision | None = None  # to the last request, in case it is sent again; None if it had no `seq`
    is_ended: bool = False  # kept only for its answer

    def keep(self, step: Step) -> None:
        """Store a step's outcome."""
        self.state = step.state or None
        self.last = step.leaves
        self.steps += 1

    def begin(self, policy: Policy) -> None:
        """Forget everything: the next step is an episode's first."""
        self.policy = policy
        self.state = self.last = None
        self.steps = 0

    def answer_again(self, seq: int | None, obs: Any) -> Decision | None:
        """Return the last request's answer if this is the same request again (because its reply was lost).

        Computing it twice would advance the recurrent state twice. Raises SessionError for a request out of order, and
        for a different one with the last one's number: the old answer would be an action for a past observation.
        """
        if seq is None or self.seq is None or seq > self.seq:
            return None
        if seq == self.seq:
            if self.policy.fingerprint(self.policy.parse(obs).arrays) == self.inputs_hash:
                return self.answer
            raise SessionError(
                f"request {seq} of this session was already answered, for another observation: give every request a "
                "larger 'seq' than the one before, or none",
                {"seq": seq, "last_seq": self.seq},
            )
        raise SessionError(
            f"request {seq} came after request {self.seq} of this session was answered: send requests in order",
            {"seq": seq, "last_seq": self.seq},
        )
