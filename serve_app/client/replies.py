"""Checks that a server's reply answers this request and fits the contract; errors raised as the server did."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.contract.contract import REWARD, Contract
from rlservo.export.contract.errors import (
    ActionError,
    DeadlineError,
    RequestError,
    RlservoError,
    SessionLostError,
    StateNeededError,
    TooLargeError,
    UnavailableError,
    UsageError,
)
from rlservo.export.contract.nested import action_leaves, build_action
from rlservo.export.contract.spaces import LeafSpec, leaf_specs
from rlservo.serve_app.wire.request_names import MARK


def decode_error(url: str, status: int, content: bytes) -> RlservoError:
    """Return the error in the body of a failed HTTP reply."""
    try:
        document = json.loads(content)
    except ValueError:
        document = None
    error = error_of(document, status)
    if error is not None:
        return error
    if status == 404:  # Ray Serve's own answer while the application is being deployed
        return UnavailableError(f"{url} answered 404 with {excerpt(content)}: no rlservo server is running there yet")
    return _class_of_status(status)(f"{url} answered {status} with {excerpt(content)}: is it an rlservo server?")


def error_of(document: Any, status: int) -> RlservoError | None:
    """Return the error in `{"error", "code", "details"?}`; None for any other document."""
    if not isinstance(document, dict) or not isinstance(document.get("error"), str):
        return None
    details = document.get("details")
    details = details if isinstance(details, dict) else {}
    kind = _classes().get(str(document.get("code")), _class_of_status(status))
    if kind is RequestError and StateNeededError.is_described_by(details):
        kind = StateNeededError
    return kind(document["error"], details)


def excerpt(content: bytes) -> str:
    """Return the beginning of a body for a message."""
    text = content[:80].decode("utf-8", "replace")
    return f"{text!r}{'...' if len(content) > 80 else ''}" if text else "an empty body"


def _classes() -> dict[str, type[RlservoError]]:
    """Return every error class by its code."""
    classes: dict[str, type[RlservoError]] = {}
    queue: list[type[RlservoError]] = [RlservoError]
    while queue:
        kind = queue.pop(0)
        classes.setdefault(kind.code, kind)  # a class precedes those that inherit its code
        queue += kind.__subclasses__()
    return classes


def _class_of_status(status: int) -> type[RlservoError]:
    """Return the error for an answer without one of our codes, for example a proxy's."""
    if status in (401, 403):
        return UsageError
    if status in (408, 504):
        return DeadlineError
    if status == 413:
        return TooLargeError
    return UnavailableError if status >= 500 or status < 400 else RequestError


def answering_version(url: str, reply: Any, number: int, contract: Contract) -> str:
    """Return the version that answered. Refuses an answer to another request or from another policy."""
    if not isinstance(reply, dict):
        raise UnavailableError(f"{url} answered with {type(reply).__name__}, expected an object")
    if reply.get("seq") != number:
        raise UnavailableError(
            f"{url} answered request {reply.get('seq')!r}, expected {number}: the action was dropped",
            {"expected": number, "actual": reply.get("seq")},
        )
    name, version = reply.get("policy"), reply.get("version")
    if name != contract.name or type(version) is not str:
        raise UnavailableError(
            f"{url} answered for policy {name!r} version {version!r}, expected {contract.name!r}: the action was "
            "dropped"
        )
    return version


def check_successor(contract: Contract, known: Contract) -> None:
    """Refuse a version whose observations or actions differ from those of the known one."""
    differing: list[str] = []
    for word, key in (("observation", "obs"), ("action", "action")):
        theirs, ours = (leaf_specs(getattr(each, f"{word}_space"), key) for each in (contract, known))
        leaves = sorted(name for name in theirs.keys() | ours.keys() if theirs.get(name) != ours.get(name))
        if leaves or getattr(contract, f"{word}_space") != getattr(known, f"{word}_space"):
            differing += leaves or [f"{word} space"]
    has_reward, had_reward = (any(tensor.name == REWARD for tensor in each.inputs) for each in (contract, known))
    differing += [REWARD] if has_reward != had_reward else []
    if differing:
        raise UnavailableError(
            f"version {contract.version} of policy '{contract.name}' answers now, and differs from version "
            f"{known.version}, which this client knows, in {', '.join(differing)}: the action was dropped; make a new "
            "client, or one with version=",
            {"version": contract.version, "known": known.version, "differing": differing},
        )


def check_step(reply: Mapping[str, Any], steps: int) -> int:
    """Return the step count of the server's memory. Raises SessionLostError unless it belongs to this episode.

    It may be ahead: a step whose answer was late, or was refused here, has advanced it nevertheless.
    """
    step = reply.get("session_step")
    if type(step) is not int or step <= steps or (steps == 0 and step != 1):
        raise SessionLostError(
            f"the server's memory is at step {step!r} of an episode, expected one after {steps}: it belongs to another "
            "episode; call reset() to begin one"
        )
    return step


def next_state(reply: Mapping[str, Any], contract: Contract) -> dict[str, Any]:
    """Return the state for the next request. Raises UnavailableError if the server sent none."""
    state = reply.get("state")
    if state is None and not contract.state:
        return {}  # the state need not be carried any more
    names = {name for name in state if not name.startswith(MARK)} if isinstance(state, dict) else None
    if not isinstance(state, dict) or names != {spec.name for spec in contract.state}:
        raise UnavailableError(f"the server's answer for {contract.name!r} lacks the state: the action was dropped")
    return state


def decode_action(reply: Mapping[str, Any], batch: tuple[int, ...], contract: Contract) -> Any:
    """Return a reply's action in the space's form, arrays of its dtype and shape, or raise ActionError.

    A stream's reply has chunks of one action: an axis of length 1 on each leaf, after the batch's.
    """
    if "actions" in reply:
        return _decode(reply["actions"], batch, (1,), contract)
    return _decode(reply.get("action"), batch, (), contract)


def is_action(action: Any, batch: tuple[int, ...], contract: Contract) -> bool:
    """Return whether this is an action of the policy for this number of observations."""
    try:
        _decode(action, batch, (), contract)
    except ActionError:
        return False
    return True


def _decode(action: Any, batch: tuple[int, ...], chunk: tuple[int, ...], contract: Contract) -> Any:
    space = contract.action_space
    try:
        leaves = action_leaves(space, action)
    except RequestError as error:
        raise ActionError(f"the server's action for {contract.name!r} cannot be read: {error}") from error
    specs = leaf_specs(space, "action")
    return build_action(
        space, {name: _decode_leaf(leaves[name], batch, chunk, name, specs[name], contract) for name in specs}
    )


def _decode_leaf(
    action: Any, batch: tuple[int, ...], chunk: tuple[int, ...], name: str, space: LeafSpec, contract: Contract
) -> NDArray[Any]:
    shape = (*batch, *chunk, *space.shape)
    what = f"action for {contract.name!r}" if name == "action" else f"{name} for {contract.name!r}"
    try:
        array = np.asarray(action)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiu" and array.size:
        raise ActionError(f"the server's {what} is {str(action)[:80]}, expected numbers")
    if array.shape != shape:
        raise ActionError(f"the server's {what} has shape {array.shape}, expected {shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ActionError(f"the server's {what} has an element that is not finite")
    converted = array.astype(space.dtype)
    if converted.dtype.kind in "iu" and not np.array_equal(converted, array):
        raise ActionError(f"the server's {what} is {str(action)[:80]}, expected {space.dtype}")
    return converted.reshape((*batch, *space.shape))
