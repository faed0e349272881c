"""The time stamp that HAProxy sets is the one that a replica reads: the wrapper imports nothing of the server's."""

from __future__ import annotations

from rlservo.serve_app.ray_serve.haproxy import configuration
from rlservo.serve_app.server import request_age


def test_wrapper_and_replica_agree_on_the_stamp() -> None:
    assert configuration.STAMP == request_age.STAMP
    assert configuration.clock() == request_age.clock()
