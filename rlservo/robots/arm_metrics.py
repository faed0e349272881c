"""Prometheus metrics of a real arm: its state, and the applied limits by element."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rlservo.robots.arm_interface import RobotError
from rlservo.robots.arm_states import ControlState


class ArmMetrics(Collector):
    """Metrics of one arm at an HTTP address, until `close`."""

    def __init__(
        self, address: str, robot: str, *, counts: Callable[[], Mapping[str, int]], state: Callable[[], ControlState]
    ) -> None:
        """Listen on `address` (HOST:PORT). Raises RobotError if that fails."""
        self._robot, self._counts, self._state = robot, counts, state
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise RobotError(f"metrics {address!r}: expected HOST:PORT to listen on, such as '127.0.0.1:9108'")
        registry = CollectorRegistry()
        registry.register(self)
        try:
            self._server, self._thread = start_http_server(int(port), host.strip("[]"), registry)
        except OSError as error:
            raise RobotError(f"metrics: cannot listen on {address}: {error}") from error

    def collect(self) -> Iterator[Metric]:
        """Yield the current metric families."""
        kept = CounterMetricFamily(
            "rlservo_robot_limited", "Cycles of a real arm's command stream in which a limit was applied",
            labels=["robot", "element"],
        )  # fmt: skip
        for element, count in self._counts().items():
            kept.add_metric([self._robot, element], count)
        yield kept
        states = GaugeMetricFamily("rlservo_robot_state", "1 for the present state", labels=["robot", "state"])
        for state in ControlState:
            states.add_metric([self._robot, state.value], state == self._state())
        yield states

    def close(self) -> None:
        """Free the port."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
