"""Recurrent state, last action and step count of a client's current episode."""

from __future__ import annotations

import copy
import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np

from rlservo.bundle.contract import Contract
from rlservo.client.replies import check_step, is_action, next_state
from rlservo.errors import SessionLostError


class ClientEpisode:
    """Episodes of a client, and their fields in a request.

    The recurrent state is kept here and sent with every request, or with `server_state` it stays on the server: in a
    session of this client, or with a stream's connection. The last action is part of it: it is sent as well whenever
    the server's may differ from the robot's command.
    """

    def __init__(self, *, server_state: bool, is_stream: bool) -> None:
        self._server_state = server_state
        self._is_stream = is_stream
        self._session_id = ""
        self._is_id_spent = True  # a request with it may reach the server after the next one
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._state: dict[str, Any] | None = {}  # of the last reply; None if the version that gave it has none
        self.steps = 0
        """Actions of the episode."""
        self._last_action: Any = None
        self._is_last_action_known = True  # whether the server has the same action
        self._is_lost = False

    def carry(self) -> None:
        """Send a `state` from now on, since the server has refused a request without one."""
        self._state = {}

    def set_last_action(self, action: Any) -> None:
        """Note the robot's command instead of the server's action."""
        self._last_action, self._is_last_action_known = action, False

    def reconnect(self) -> None:
        """Note a new connection, which has no memory of the episode."""
        self._is_lost = self.steps > 0

    def request_fields(self, contract: Contract, batch: tuple[int, ...], *, ends: bool = False) -> dict[str, Any]:
        """Return the next request's fields on the episode, `ends` if it reports the end.

        Before its reply, the server may have decided an action that never reached the robot.

        Raises SessionLostError when the recurrent state was lost with a connection.
        """
        fields: dict[str, Any] = {}
        if self._is_on_server(contract):
            if self._is_lost:
                raise SessionLostError("the connection broke and the episode's memory was lost: call reset()")
            fields["reset"] = self.steps == 0
            if not self._is_stream:
                if self._is_id_spent:
                    self._session_id = uuid.uuid4().hex
                self._is_id_spent = self.steps == 0
                fields["session_id"] = self._session_id
                fields |= {"end": True} if ends else {}
        elif self._state is not None:
            fields["state"] = self._state
        has_last_action = bool(fields) or self._is_stream
        if has_last_action and not self._is_last_action_known and is_action(self._last_action, batch, contract):
            fields["last_action"] = self._last_action
        self._is_last_action_known = False
        return fields

    def end(self) -> None:
        """Note that the server knows the episode's end: the next episode gets its own session."""
        self.reset()
        self._is_id_spent = True

    def advance(self, reply: Mapping[str, Any], action: Any, contract: Contract) -> None:
        """Advance to the next step after a reply; `action` is the reply's.

        Raises SessionLostError when the reply belongs to another episode, UnavailableError when it lacks the state.
        """
        self._is_id_spent = False
        if not self._is_on_server(contract):
            self._state = next_state(reply, contract)
            self.steps += 1
        elif contract.state or "session_step" in reply:
            self.steps = check_step(reply, self.steps)
        else:
            self.steps += 1
        # The loop may write into its own.
        self._last_action = action.copy() if isinstance(action, np.ndarray) else copy.deepcopy(action)
        self._is_last_action_known = True

    def _is_on_server(self, contract: Contract) -> bool:
        return self._server_state and (bool(contract.state) or not self._is_stream)
