"""Names and bounds in requests, shared by client and server."""

from __future__ import annotations

LABEL_HEADER = "x-session-id"
"""Header that names the client, for a canary; Ray Serve's own routing also reads it."""

LONGEST_STATUS = 64
"""Most characters of a `final_status`."""

MARK = "@"
"""First character of the names in a carried recurrent state that are not arrays of the policy's graph. A client returns
them unchanged."""

BELONGS_TO = "@policy"
"""`<name>/<version>#<the graph's hash>`: `Policy.identity`."""

LAST_ACTION = "@last_action"
"""Name of the last action, if the step from it is limited."""

SUCCESS = "success"
"""The `final_status` of an episode that reached its goal."""
