"""Session: recurrent state of a running episode on the server, and its last answer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.errors import SessionError
from rlservo.policy.policy import Policy
from rlservo.policy.recurrent_state import State


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
    is_ended: bool = False  # kept only to answer its last request again
    # Of the last request:
    seq: int | None = None
    inputs_hash: bytes = b""  # of its observation
    infer_ms: float = 0.0
    batch: int | None = None
    notices: tuple[str, ...] = ()

    def has_answered(self, seq: int | None, obs: Any) -> bool:
        """Return whether this is the last request again (because its reply was lost).

        Computing it twice would advance the recurrent state twice. Raises SessionError for a request out of order, and
        for a different one with the last one's number: the old answer would be an action for a past observation.
        """
        if seq is None or self.seq is None or seq > self.seq:
            return False
        fault = f"came after request {self.seq} of this session was answered: send requests in order"
        if seq == self.seq:
            if self.policy.fingerprint(self.policy.parse(obs).arrays) == self.inputs_hash:
                return True
            fault = (
                "of this session was already answered, for another observation: give every request a larger 'seq' than "
                "the one before, or none"
            )
        raise SessionError(f"request {seq} {fault}", {"seq": seq, "last_seq": self.seq})
