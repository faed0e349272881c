"""Names in a carried recurrent state that are no array of the policy's graph."""

from __future__ import annotations

MARK = "@"  # begins each of them; no recurrent state's name does. A client sends them back as they came
BELONGS_TO = "@policy"  # `<name>/<version>#<the graph's hash>`: `Policy.identity`
LAST_ACTION = "@last_action"  # where the step from one action to the next is limited
