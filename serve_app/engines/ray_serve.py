"""Distributed engine: the application as one Ray Serve deployment, run by Ray's own commands.

`serve run rlservo.serve_app.engines.ray_serve:build policies=DIR`, `serve deploy deploy/serve.yaml`. Ray starts,
scales, replaces and upgrades the replicas. One deployment holds every policy: a policy takes kilobytes and
microseconds, a hop to another actor milliseconds. A replica imports neither torch nor ray.rllib.
"""

# No `from __future__ import annotations` here: Serve reads the type of build's argument to parse `args`.

import asyncio
import contextlib
import logging
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, cast

import grpc
import ray
from pydantic import BaseModel, ConfigDict, Field, field_validator
from ray import serve
from ray.serve import Application, Deployment

from rlservo.client.formats.addresses import is_loopback
from rlservo.errors import RlservoError
from rlservo.serve_app.engines.autoscaling import BUSY, ThreadLoad
from rlservo.serve_app.engines.server_process import running
from rlservo.serve_app.protocols.asgi_app import PolicyApp, create_app
from rlservo.serve_app.protocols.open_inference.grpc_service import Grpc
from rlservo.serve_app.protocols.open_inference.oip_messages import SERVICE, STREAM, UNARY
from rlservo.serve_app.repository.places import place_of
from rlservo.serve_app.server.api_keys import check_exposure
from rlservo.serve_app.server.logs import configure
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import plan_follower
from rlservo.serve_app.versions.computing import left_by_dead, write_to

logger = logging.getLogger(__name__)

DEPLOYMENT = "PolicyServer"
SPARE = 64  # requests for health, metrics and documentation
SWITCHES = ("RAY_SERVE_ENABLE_HA_PROXY", "RAY_SERVE_THROUGHPUT_OPTIMIZED")
CONTROLLER = ("SERVE_CONTROLLER_ACTOR", "serve")  # the name and namespace of Serve's controller
EVERYWHERE = "0.0.0.0"


class BuildArguments(BaseModel):
    """The `args` of an application in serve.yaml, or `key=value` after `serve run`."""

    model_config = ConfigDict(extra="forbid")

    policies: list[str] = Field(min_length=1)
    """Bundle folders, policy folders, repositories, or URIs of published ones; on the command line separated by
    commas."""

    replicas: int = Field(1, ge=1)
    """Processes that serve the same policies; each loads all of them."""

    settings: dict[str, Any] = {}
    """Fields of ServerSettings; missing ones come from RLSERVO_* variables, then from the defaults."""

    @field_validator("policies", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return value.split(",") if isinstance(value, str) else value


def build(args: BuildArguments) -> Application:
    """Return the application for `serve run` and `serve deploy`. Raises UsageError.

    Relative folders are resolved here, since a replica runs in another directory.
    """
    settings = ServerSettings.from_environment(args.settings)
    # A folder may exist only on the nodes that run replicas, so the replica checks it.
    places = [place_of(place) for place in args.policies]
    server: Deployment = cast("Deployment", PolicyServer)  # the decorator is typed as if it returned the class
    # Above a replica's own limit: requests held back by Serve would wait behind clients that send bodies slowly.
    limit = settings.max_ongoing_requests + settings.max_incoming + settings.max_streams + SPARE
    options = server.options(num_replicas=args.replicas, max_ongoing_requests=limit)
    return options.bind(places, settings.model_dump())


class InferenceMethods:
    """The gRPC methods that Serve looks for on the deployment's class; messages are bytes (`add_service`)."""

    _grpc: Grpc

    async def ModelStreamInfer(self, requests: AsyncIterator[bytes], grpc_context: Any) -> AsyncIterator[Any]:
        async for reply in self._grpc.stream(requests, grpc_context):
            yield reply


def _method(name: str) -> Any:
    async def answer(self: InferenceMethods, request: bytes, grpc_context: Any) -> Any:
        return await self._grpc.answer(name, request, grpc_context)

    return answer


for _name in UNARY:
    setattr(InferenceMethods, _name, _method(_name))


@serve.deployment(
    name=DEPLOYMENT,
    # A policy server mostly waits; reserving a whole logical CPU would only keep replicas off small machines.
    ray_actor_options={"num_cpus": 0.1},
    # A line per request costs more than the policy; below this level Serve still formats it and drops it (5%).
    logging_config={"enable_access_log": False, "log_level": "WARNING"},
    health_check_period_s=1,  # a replica that hangs is replaced after three checks
    health_check_timeout_s=5,  # on a starved node an event loop may wait for seconds
    graceful_shutdown_timeout_s=15,
    user_config={},
    max_surge_percent=100,  # a rolling update starts the new replica before the old one stops
)
@serve.ingress()
class PolicyServer(InferenceMethods):
    """A replica: the policies, the HTTP application and the gRPC methods over them."""

    def __init__(self, places: list[str], settings: dict[str, Any]) -> None:
        """Check the settings. Serve calls `reconfigure` next, and sends requests only after that."""
        self._settings = ServerSettings(**settings)
        self._load = ThreadLoad()
        replica = serve.get_replica_context().replica_tag
        host = _listening_host()
        try:
            # Serve may have replaced `sys.stderr` by a logger that drops what is written there.
            with contextlib.redirect_stderr(sys.__stderr__):
                configure(self._settings, replica=replica)
            self._folder = _log_deaths()
            check_exposure(host, self._settings)
            self._control = plan_follower(places, self._settings)
            self._app = create_app(
                self._control, self._settings, replica=replica, host=host, is_alone=False, is_behind_serve=True
            )
        except RlservoError as error:
            raise _plain(error) from None
        self._running = contextlib.AsyncExitStack()
        self._running.push_async_callback(self._app.handler.close)
        self._grpc = Grpc(self._app.handler, local_only=is_loopback(host))
        if os.environ.get(SWITCHES[0]) != "1":
            logger.warning(
                "requests reach this replica through Serve's Python proxy, ten times slower than HAProxy: set %s=1 and "
                "%s=1 for `serve run`, or for `ray start` on every node",
                *SWITCHES,
            )
        if os.getpriority(os.PRIO_PROCESS, 0) > os.getpriority(os.PRIO_PROCESS, os.getppid()):
            logger.warning(
                "this replica gives way to all other programs of its machine, so answers may be late: set "
                "RAY_worker_niceness=0 for `serve run`, or for `ray start` on every node"
            )

    def __serve_build_asgi_app__(self) -> PolicyApp:  # Serve's hook: the app is built in the replica
        return self._app

    async def reconfigure(self, user_config: Any) -> None:
        """Apply the configuration: Serve calls this at the start, and on `serve deploy` with a new one.

        Serve sends a replica no requests while this runs, so only the first call waits until everything is loaded.
        """
        if self._control.store is not None:
            self._reconfiguring = asyncio.create_task(self._configure(user_config))
            return
        try:
            await self._running.enter_async_context(running(self._app.handler, user_config, self._folder))
        except RlservoError as error:
            raise _plain(error) from None

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Report this replica's load to Serve's autoscaler, for `autoscaling.by_load`."""
        return {BUSY: self._load.measure()}

    async def check_health(self) -> None:
        """Report that the event loop runs and the policies are loaded; otherwise Serve replaces this replica."""
        await asyncio.sleep(0)
        if self._control.store is None:
            raise RuntimeError("no policies are loaded: the deployment's user_config must be a map, not null")

    async def __del__(self) -> None:
        """End the recording. Serve calls this after the replica has answered its last request."""
        if (stack := getattr(self, "_running", None)) is not None:
            await stack.aclose()

    async def _configure(self, user_config: Any) -> None:
        try:
            await self._control.configure(user_config)
        except Exception:
            logger.exception("the configuration cannot be read; still serving the previous one")


def _log_deaths() -> Path:
    """Log what replicas that died on this node were computing, and write down what this one computes.

    Returns the folder of this node's replicas, which lives as long as Ray does.
    """
    context = ray.get_runtime_context()
    folder = Path(context.get_temp_dir(), context.get_session_name(), "rlservo")
    folder.mkdir(exist_ok=True)
    for pid, computing in left_by_dead(folder).items():
        if computing:  # otherwise it may have been stopped
            logger.error("a replica (process %d) died while computing %s", pid, " and ".join(computing))
    write_to(folder)
    return folder


def add_service(_servicer: Any, server: Any) -> None:
    """Register the Open Inference Protocol with one of Serve's gRPC servers.

    `grpc_options.grpc_servicer_functions: [rlservo.serve_app.engines.ray_serve:add_service]` names it to Serve, which
    replaces these functions with its own, and passes a request on to the replica's method of the same name. Messages
    stay bytes until then, so that garbage is answered like any other error.
    """
    methods: dict[str, Any] = {name: grpc.unary_unary_rpc_method_handler(_nothing) for name in UNARY}
    methods[STREAM] = grpc.stream_stream_rpc_method_handler(_nothing)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))


def _nothing(_request: Any, _context: Any) -> None:
    """Serve replaces this function with its own."""


def _plain(error: RlservoError) -> RuntimeError:
    """Return one sentence: Ray pickles a constructor's exception, and prints its text."""
    return RuntimeError(error.message)


def _listening_host() -> str:
    """Return the address in Serve's HTTP options, or 0.0.0.0 if Serve does not report one.

    Serve has no public function for it. Its controller has a well-known name and answers; a Serve with another
    controller is assumed to listen everywhere, which requires API keys.
    """
    try:
        controller: Any = ray.get_actor(*CONTROLLER)
        options: Any = ray.get(controller.get_http_config.remote())
        return str(options.host)
    except (ValueError, AttributeError):
        return EVERYWHERE
