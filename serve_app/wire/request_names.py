"""Names and bounds in requests that client and server share."""

from __future__ import annotations

LABEL_HEADER = "x-session-id"
"""Whose request it is, when a canary runs; Ray Serve's own routing also knows the header."""

LONGEST_STATUS = 64
"""Characters of a `final_status`."""

MARK = "@"
"""First character of the names in a carried recurrent state that are not arrays of the policy's graph.
A client sends them back as they came."""

BELONGS_TO = "@policy"
"""`<name>/<version>#<the graph's hash>`: `Policy.identity`."""

LAST_ACTION = "@last_action"
"""Name of the last action, if the step from it is limited."""
