"""Session: the recurrent state of a running episode on the server, and its last answer."""

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
    """One episode, or so many side by side, of one policy in one version."""

    policy: Policy
    state: State | None = None  # None: at its start
    last: dict[str, NDArray[np.generic]] | None = None  # the last action's leaves
    steps: int = 0
    rows: int = 0  # episodes that it takes the place of
    used: float = field(default_factory=time.monotonic)
    begun: float = field(default_factory=time.perf_counter)  # the episode: no two of an id have the same
    connection: Any = None  # of the last request
    seq: int | None = None  # of the last request that was answered
    inputs_hash: bytes = b""  # of its observation
    answer: Decision | None = None  # to the last request, for the same request sent again; None if it had no `seq`
    is_ended: bool = False  # kept only for its answer

    def keep(self, step: Step) -> None:
        """Remember a step's outcome."""
        self.state = step.state or None
        self.last = step.leaves
        self.steps += 1

    def begin(self, policy: Policy) -> None:
        """Forget everything: the next step is an episode's first."""
        self.policy = policy
        self.state = self.last = None
        self.steps = 0

    def answer_again(self, seq: int | None, obs: Any) -> Decision | None:
        """Return the last request's answer if this is the same request again (its reply got lost).

        To compute it twice would move the recurrent state on twice. Raises SessionError for a request that comes out of
        order, and for another one under the last one's number: the old answer would be an action for what is long past.
        """
        if seq is None or self.seq is None or seq > self.seq:
            return None
        if seq == self.seq:
            if self.policy.fingerprint(self.policy.parse(obs).arrays) == self.inputs_hash:
                return self.answer
            raise SessionError(
                f"request {seq} of its session was answered already, for another observation: give every request a "
                "larger 'seq' than the one before, or none",
                {"seq": seq, "last_seq": self.seq},
            )
        raise SessionError(
            f"request {seq} came after request {self.seq} of its session was answered: send them in order",
            {"seq": seq, "last_seq": self.seq},
        )
