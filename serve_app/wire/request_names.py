"""Names and bounds in requests that client and server share."""

from __future__ import annotations

LABEL_HEADER = "x-session-id"
"""Whose request it is, where a canary runs; Ray Serve's own routing knows the header, too."""

LONGEST_STATUS = 64
"""Characters of a `final_status`."""

MARK = "@"
"""Begins each name in a carried recurrent state that is no array of the policy's graph; no recurrent state's name does.
A client sends them back as they came."""

BELONGS_TO = "@policy"
"""`<name>/<version>#<the graph's hash>`: `Policy.identity`."""

LAST_ACTION = "@last_action"
"""Where the step from one action to the next is limited."""
