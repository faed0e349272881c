"""Clients that send requests one after the other, and the replies they got."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from rlservo.client.policy_client import PolicyClient
from rlservo.errors import RlservoError

CLIENTS = 8
PATIENCE_S = 120  # [s] on a busy machine


@dataclass
class Load:
    """Clients of one policy, which ask again at once if a connection breaks."""

    port: int
    policy: str
    obs: Sequence[float]
    expected: Sequence[NDArray[Any]]
    """The actions that are right: one for each version that may answer."""
    api_key: str | None = None
    pause_s: float = 0.02
    """After each of a client's requests [s]."""
    version: str | None = None
    asked: int = 0
    failures: list[str] = field(default_factory=list)
    wrong: int = 0

    @contextlib.contextmanager
    def run(self) -> Iterator[Load]:
        ended = threading.Event()
        threads = [threading.Thread(target=self._ask, args=(ended,)) for _ in range(CLIENTS)]
        for thread in threads:
            thread.start()
        try:
            yield self
        finally:
            ended.set()
            for thread in threads:
                thread.join(PATIENCE_S)

    def _ask(self, ended: threading.Event) -> None:
        url = f"http://127.0.0.1:{self.port}"
        with PolicyClient(
            url, self.policy, timeout_s=5, retries=3, api_key=self.api_key, version=self.version
        ) as policy:
            while not ended.is_set():
                try:
                    action = policy.act(self.obs)
                except RlservoError as error:
                    self.failures.append(error.message)
                else:
                    self.wrong += not any(np.array_equal(action, right) for right in self.expected)
                self.asked += 1
                time.sleep(self.pause_s)


def busiest(pids: Sequence[int]) -> int:
    """Return the process that uses the processor most: clients' connections may all be to one worker."""
    return max(pids, key=lambda pid: psutil.Process(pid).cpu_percent(interval=0.5))
