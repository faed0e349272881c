"""Recurrent state carried by the client, tagged with its policy version so that no other version accepts it.

A reply's state names the graph that it belongs to and, if the step from one action to the next is limited, holds the
last action. Both have names that no recurrent state has, so a client that sends the state back need not know them. On a
server that records, the graph's name is followed by the episode's name and the number of the next step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from rlservo.client.formats.request_names import BELONGS_TO, LAST_ACTION, MARK
from rlservo.errors import RequestError
from rlservo.policy.policy import Policy, Step
from rlservo.serve_app.versions.policy_store import EpisodeStep

MARK_BEGINS = "~"  # no policy's identity has one
LONGEST_EPISODE_ID = 256


class CarriedState(NamedTuple):
    """The parts of a state in a request."""

    arrays: Mapping[str, Any]  # by state name
    policy_identity: str | None  # of the policy that produced the state; None if the client has dropped it
    last_action: Any
    mark: EpisodeStep | None  # of the step in a recording


def parse_state(state: Mapping[str, Any]) -> CarriedState:
    """Return the parts of a request's state. Raises RequestError."""
    arrays = {name: value for name, value in state.items() if not str(name).startswith(MARK)}
    unknown = [name for name in state if name not in arrays and name not in (BELONGS_TO, LAST_ACTION)]
    if unknown:
        raise RequestError(
            f"the state has the unknown entry '{str(unknown[0])[:64]}': send back what the last reply gave"
        )
    belongs_to = state.get(BELONGS_TO)
    if belongs_to is not None and type(belongs_to) is not str:
        raise RequestError(f"the state's '{BELONGS_TO}' must be the string from the last reply")
    identity, mark = (None, None) if belongs_to is None else split_identity(belongs_to)
    return CarriedState(arrays, identity, state.get(LAST_ACTION), mark)


def split_identity(belongs_to: str) -> tuple[str, EpisodeStep | None]:
    """Return the policy's identity and the episode's mark, which a client may have altered."""
    identity, _, rest = belongs_to.partition(MARK_BEGINS)
    episode, _, step = rest.rpartition(MARK_BEGINS)
    if not episode or len(episode) > LONGEST_EPISODE_ID or not (step.isascii() and step.isdigit() and len(step) < 16):
        return identity, None
    return identity, EpisodeStep(episode, int(step))


def carry(policy: Policy, step: Step, mark: EpisodeStep | None) -> dict[str, Any]:
    """Return the state for the client's next request; `mark` is for a recording."""
    carried: dict[str, Any] = dict(step.own_state)
    carried[BELONGS_TO] = policy.identity
    if mark is not None:
        carried[BELONGS_TO] += f"{MARK_BEGINS}{mark.episode}{MARK_BEGINS}{mark.step}"
    if policy.has_step_limit:
        carried[LAST_ACTION] = step.action
    return carried
