"""Networks in memory within a bound: the one used longest ago is dropped for another, and opened again when asked.

Everything else of a policy stays: its contract, and that it was proven. What is opened again is the very file whose
hash was checked then. A network that computes is in nobody's way: who runs it holds it until the run has ended.
"""

from __future__ import annotations

import ctypes
import math
import threading
import time
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from rlservo.export.contract.bundle import Bundle
from rlservo.export.contract.errors import BundleError, NetworkAwayError
from rlservo.serve_app.runtime.loading import open_graph

if TYPE_CHECKING:
    import onnxruntime

M_MMAP_THRESHOLD = -3  # of glibc's malloc.h
RETRY_S = 1.0  # [s] until a network that could not be opened is tried again: each time reads the whole file
LARGE_BYTES = 128 << 10  # [bytes] glibc's own threshold, before it adapts


class NetworkDroppedError(Exception):
    """The network is not in memory: `restore` it, in a thread where an event loop asked, and ask again."""

    def __init__(self, network: DroppableNetwork) -> None:
        super().__init__(network.what)
        self.network = network


class NetworkMemory:
    """Bound of the networks that a process keeps in memory, in bytes of their `policy.onnx`."""

    def __init__(self, most_bytes: int) -> None:
        """One network that is larger by itself is kept alone."""
        self._most_bytes = most_bytes
        self._networks: weakref.WeakSet[DroppableNetwork] = weakref.WeakSet()
        self._lock = threading.Lock()
        _give_large_blocks_back()

    def add(self, bundle: Bundle, ort_session: onnxruntime.InferenceSession, threads: int) -> DroppableNetwork:
        """Return a network that was just opened, and from now on counts. Raises BundleError where its file is gone."""
        try:
            size = bundle.onnx.stat().st_size
        except OSError as error:
            raise BundleError(f"{bundle.onnx} cannot be read: {error.strerror}") from None
        network = DroppableNetwork(self, bundle, ort_session, threads, size)
        with self._lock:
            self._networks.add(network)
        self.make_room(network)
        return network

    def make_room(self, network: DroppableNetwork) -> None:
        """Drop others, used longest ago first, until this one fits beside them."""
        with self._lock:
            others = sorted(
                (each for each in self._networks if each is not network and each.is_in_memory),
                key=lambda each: each.used_at,
            )
            excess = network.size + sum(each.size for each in others) - self._most_bytes
            for other in others:
                if excess <= 0:
                    return
                excess -= other.size
                other.drop()


class DroppableNetwork:
    """onnxruntime's session of one policy, which may be dropped between two runs."""

    def __init__(
        self,
        memory: NetworkMemory,
        bundle: Bundle,
        ort_session: onnxruntime.InferenceSession,
        threads: int,
        size: int,
    ) -> None:
        self._memory = memory
        self._bundle = bundle
        self._threads = threads
        self._ort_session: onnxruntime.InferenceSession | None = ort_session
        self._opening = threading.Lock()
        self._failed_at = -math.inf
        self._failure = ""
        self.size = size
        """[bytes] of the graph's file; onnxruntime takes up to twice of it."""
        self.used_at = time.monotonic()
        self.restores = 0
        """How often it was opened again."""

    @property
    def what(self) -> str:
        """Policy and version, for a sentence."""
        return f"policy '{self._bundle.contract.name}' version {self._bundle.contract.version}"

    @property
    def version(self) -> str:
        return self._bundle.contract.version

    @property
    def is_in_memory(self) -> bool:
        return self._ort_session is not None

    def run(self, names: Sequence[str], feed: dict[str, NDArray[Any]]) -> Any:
        """Compute, as onnxruntime's `run`. Raises NetworkDroppedError: an event loop must not wait for files."""
        ort_session = self._ort_session  # dropped from here on, it ends with this run
        if ort_session is None:
            raise NetworkDroppedError(self)
        self.used_at = time.monotonic()
        return ort_session.run(names, feed)

    def restore(self) -> onnxruntime.InferenceSession:
        """Open the network unless it is in memory; blocks. Raises NetworkAwayError."""
        with self._opening:
            ort_session = self._ort_session
            if ort_session is None:
                if time.monotonic() - self._failed_at < RETRY_S:
                    raise NetworkAwayError(self._failure)
                try:
                    ort_session = open_graph(self._bundle, self._threads, acts_only=True)
                except BundleError as error:
                    self._failed_at = time.monotonic()
                    self._failure = (
                        f"{self.what} is not in memory (network_bytes), and cannot be opened again: {error.message}"
                    )
                    raise NetworkAwayError(self._failure) from error
                self.used_at = time.monotonic()  # before it can be dropped again
                self._ort_session = ort_session
                self.restores += 1
                self._memory.make_room(self)  # only now: one that cannot be opened costs nobody else's
            return ort_session

    def drop(self) -> None:
        """Let the memory go; a run that is under way keeps it until its end."""
        self._ort_session = None


def _give_large_blocks_back() -> None:
    """Let the C library give large blocks (weights) back to the system as soon as they are free.

    glibc raises its threshold for that with the first such block that is freed, and keeps the later ones in pieces that
    nothing else fits into: with a bound of 100 networks the memory of 300 to 400 stayed.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # glibc's
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
