"""Environment variables that every Ray process started from here needs, set before Ray is imported.

Ray reads these when it is first imported, so every module that imports Ray imports this first.
"""

from __future__ import annotations

import os

# Ray 2.60 turns token authentication on once any local ray.init() has written a token; set here, it is always on.
os.environ.setdefault("RAY_AUTH_MODE", "token")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_AIR_NEW_OUTPUT", "0")
# Ray would start a worker process for each core when a driver connects, and for tasks that wait; none of them has the
# runtime environment of `ray_session` or of Tune's trials, so that it would wait in vain.
os.environ.setdefault("RAY_enable_worker_prestart", "0")
os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
