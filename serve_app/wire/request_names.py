"""Names and bounds in requests that client and server share."""

from __future__ import annotations

LABEL_HEADER = "x-session-id"
"""Whose request it is, where a canary runs; Ray Serve's own routing knows the header, too."""

LONGEST_STATUS = 64
"""Characters of a `final_status`."""
