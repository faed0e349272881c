"""Error replies become the errors that the server raised."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rlservo.bundle.bundle import read_contract
from rlservo.client.http_transport import BrokenError  # noqa: F401 - one that inherits its code
from rlservo.client.replies import decode_action, decode_error, error_of
from rlservo.errors import (
    ActionError,
    DeadlineError,
    OverloadedError,
    RequestError,
    RlservoError,
    StateNeededError,
    TooLargeError,
    UnavailableError,
    UsageError,
)
from rlservo.serve_app.protocols.error_statuses import error_answer


@pytest.mark.parametrize(
    "error",
    [
        UnavailableError("not yet"),
        OverloadedError("too much", {"limit": 8}),
        RequestError("no JSON", {"send": "JSON"}),
        StateNeededError("it remembers"),
        TooLargeError("too large"),
    ],
)
def test_an_error_of_the_server_comes_back_as_it_was_raised(error: RlservoError) -> None:
    status, body, _ = error_answer(error)
    decoded = decode_error("http://host", status, body)
    assert (type(decoded), decoded.message, decoded.details) == (type(error), error.message, error.details)


def test_lack_of_state_is_a_bad_request_with_details_on_the_wire() -> None:
    _, body, _ = error_answer(StateNeededError("it remembers"))
    assert json.loads(body) == {"error": "it remembers", "code": "bad-request", "details": {"send": "state"}}


@pytest.mark.parametrize(
    ("status", "kind"),
    [(401, UsageError), (404, UnavailableError), (408, DeadlineError), (413, TooLargeError), (502, UnavailableError)],
)
def test_without_a_code_of_ours_the_status_says_what_it_is(status: int, kind: type[RlservoError]) -> None:
    assert type(decode_error("http://host", status, b"<html>")) is kind
    assert error_of({"detail": "somebody else's"}, status) is None


@pytest.mark.parametrize("element", [1e300, -1e39, float("nan"), float("inf")])
def test_an_action_that_is_not_finite_in_the_spaces_type_is_refused(ur5: Path, element: float) -> None:
    contract = read_contract(ur5)
    given: dict[str, Any] = {"action": [0.0] * 5 + [element]}
    with pytest.raises(ActionError, match="'ur5' has an element that is not finite in float32"):
        decode_action(given, (), contract)
    given["action"][5] = 1.5
    assert decode_action(given, (), contract).tolist() == given["action"]
