"""The time stamp that HAProxy sets is the one that a replica reads: the wrapper imports nothing of the server's."""

from __future__ import annotations

from rlservo.serve_app.ray_serve.haproxy import configuration
from rlservo.serve_app.server import loop_clock


def test_wrapper_and_replica_agree_on_the_stamp() -> None:
    assert configuration.STAMP == loop_clock.STAMP
    assert configuration.clock() == loop_clock.clock_id()
