"""Recurrent state carried by the client, tagged with its policy version so that no other accepts it.

A reply's state names the graph that it belongs to, and, where the step from one action to the next is limited, holds
the last action. Both stand under names that no recurrent state has, so a client that sends back what it got needs to
know neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rlservo.export.contract.errors import RequestError
from rlservo.serve_app.runtime.policy import Policy, Step
from rlservo.serve_app.wire.state_names import BELONGS_TO, LAST_ACTION, MARK


@dataclass(frozen=True, slots=True)
class CarriedState:
    """A state as a request brought it, taken apart."""

    arrays: Mapping[str, Any]
    """By state name."""

    is_empty: bool = False
    """An episode begins."""

    policy_identity: str | None = None
    """The identity of the policy that gave it; None where the client has dropped it."""

    last_action: Any = None

    @classmethod
    def parse(cls, state: Mapping[str, Any]) -> CarriedState:
        """Take a request's state apart. Raises RequestError."""
        if not state:
            return NO_STATE
        arrays = {name: value for name, value in state.items() if not str(name).startswith(MARK)}
        if len(arrays) == len(state):
            return cls(arrays)
        unknown = [name for name in state if name not in arrays and name not in (BELONGS_TO, LAST_ACTION)]
        if unknown:
            raise RequestError(
                f"the state has the unknown entry '{str(unknown[0])[:64]}': send back what the last reply gave"
            )
        policy_identity = state.get(BELONGS_TO)
        if policy_identity is not None and type(policy_identity) is not str:
            raise RequestError(f"the state's '{BELONGS_TO}' must be the string that the last reply gave")
        return cls(arrays, policy_identity=policy_identity, last_action=state.get(LAST_ACTION))


NO_STATE = CarriedState({}, is_empty=True)


def carry(policy: Policy, step: Step) -> dict[str, Any]:
    """Return the state that a client is to send with its next request."""
    carried: dict[str, Any] = dict(step.own_state)
    carried[BELONGS_TO] = policy.identity
    if policy.has_step_limit:
        carried[LAST_ACTION] = step.action
    return carried
