"""Guard of a velocity topic: publishes zeros when its standard input falls silent, and once when it ends.

ros2_control's forward velocity controller has no timeout: the arm of a killed process would continue to move.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time

from rlservo.robots.ros2.rclpy_link import GUARD, RclpyLink
from rlservo.robots.ros2.ros_messages import NUMBERS

READY = b"ready\n"  # on standard output: the guard is active
SILENCE_S = 0.1
SETTLE_S = 0.5  # for the last zeros to reach the controller


def main(topic: str) -> None:
    """Guard a topic until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link = RclpyLink(GUARD)
    publish, is_fed = link.advertise(topic, NUMBERS), False  # advertised now, as a subscriber takes a while to find it
    while not (link.subscribers(topic) or select.select([0], [], [], SILENCE_S)[0]):
        pass
    time.sleep(SETTLE_S)
    with contextlib.suppress(BrokenPipeError):  # standard input has ended too
        os.write(1, READY)
    while True:
        ready, _, _ = select.select([0], [], [], SILENCE_S)
        if ready and not os.read(0, 4096):
            break
        is_fed = is_fed or bool(ready)
        if is_fed and not ready:
            publish({"data": [0.0] * 6})
    for _ in range(int(SETTLE_S / SILENCE_S) if is_fed else 0):  # otherwise the topic may belong to another node
        publish({"data": [0.0] * 6})
        select.select([], [], [], SILENCE_S)
    link.close()


if __name__ == "__main__":
    main(sys.argv[1])
