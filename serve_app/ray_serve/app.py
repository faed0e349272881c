"""Ray Serve application: one deployment that holds every policy.

One deployment holds every policy: a policy is kilobytes and microseconds, a hop to another actor is milliseconds. From
a checkout: `serve run deploy/serve.yaml`, or `serve run rlservo.serve_app.ray_serve.app:build policies=DIR`. `rlservo
serve` comes here through `cluster_process.py`. A replica imports neither torch nor ray.rllib.
"""

# No `from __future__ import annotations` here: Serve reads the type of build's argument to know what to make of `args`.

import asyncio
import gc
import http.client
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import Any, cast

import ray
from pydantic import BaseModel, ConfigDict, Field, field_validator
from ray import serve
from ray.exceptions import ActorDiedError, RayError
from ray.serve import Application, Deployment
from ray.serve.config import HTTPOptions, gRPCOptions

from rlservo.export.contract.errors import PartlyAppliedError, RlservoError, UnavailableError
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.http_endpoint import PolicyApp
from rlservo.serve_app.protocols.oip_grpc import InferenceService
from rlservo.serve_app.ray_serve import direct_port, grpc_ingress, http_connections, ingress, ray_parts, uvicorn_parts
from rlservo.serve_app.ray_serve.autoscaling import BUSY, Load
from rlservo.serve_app.ray_serve.direct_server import DirectServer
from rlservo.serve_app.ray_serve.gcs_ledger import GcsLedger
from rlservo.serve_app.ray_serve.replica_peers import GcsRecords, ReplicaPeers
from rlservo.serve_app.server import listing
from rlservo.serve_app.server.api_keys import check_exposure
from rlservo.serve_app.server.core import Core
from rlservo.serve_app.server.request_log import configure
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import version_loader
from rlservo.serve_app.versions.object_storage import place_of
from rlservo.serve_app.versions.plan import ServedConfig
from rlservo.serve_app.versions.replica_versions import ReplicaProgress, ReplicaVersions
from rlservo.serve_app.wire.direct_offer import EVERYWHERE, OFFER, make_offer
from rlservo.serve_app.wire.loopback import is_loopback

logger = logging.getLogger(__name__)

APPLICATION = "rlservo"
DEPLOYMENT = "PolicyServer"
SPARE = 64  # health, metrics, documentation
GRPC_SERVICE = "rlservo.serve_app.ray_serve.grpc_ingress:add_service"
SWEEP_PERIOD_S = 300.0  # [s] between looks for records of sessions that are no more
ANSWERED = 10  # connections in a row, until a start is over
ANSWER_TIMEOUT_S = 60.0
FOLLOW_TIMEOUT_S = 45.0  # [s] for every replica to load and prove what a change brought


class BuildArguments(BaseModel):
    """The `args` of an application in serve.yaml, or `key=value` after `serve run`."""

    model_config = ConfigDict(extra="forbid")

    policies: list[str] = Field(min_length=1)
    """Bundle folders, policy folders, repositories, or URIs of published ones; on the command line separated by
    commas."""

    replicas: int = Field(1, ge=1)
    """Processes that serve the same policies; each loads all of them."""

    served: dict[str, Any] = {}
    """Versions, aliases, canary and shadow (ServedConfig), for where `user_config` cannot be given; that wins."""

    single: bool = False
    """Whether there is never another replica, as in `rlservo serve`: sessions by id need no records then."""

    settings: dict[str, Any] = {}
    """Fields of ServerSettings; what is not given comes from RLSERVO_* variables, then from the defaults."""

    @field_validator("policies", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return value.split(",") if isinstance(value, str) else value


def build(args: BuildArguments) -> Application:
    """Return the application for `serve run`, `serve deploy` and `rlservo serve`.

    Relative folders are taken from the directory this runs in, since a replica's own is another. Raises UsageError, and
    RuntimeError in a Ray that lacks what is used of its private parts.
    """
    ray_parts.check()
    uvicorn_parts.check()
    settings = ServerSettings.from_environment(args.settings)
    ServedConfig.parse(args.served)
    # A folder may exist only on the nodes that run replicas, so it is the replica that looks.
    places = [place_of(place) for place in args.policies]
    server: Deployment = cast("Deployment", PolicyServer)  # the decorator's type says it is still the class
    options = server.options(
        num_replicas=args.replicas, max_ongoing_requests=_serve_limit(settings), user_config=args.served
    )
    return options.bind(places, settings.model_dump(), args.single)


def _serve_limit(settings: ServerSettings) -> int:
    """Return more than a replica takes on: who waits at Serve's limit waits for whoever is slow to send a body."""
    return settings.max_ongoing_requests + settings.max_incoming + settings.max_streams + SPARE


@serve.deployment(
    name=DEPLOYMENT,
    # A policy server spends its time waiting; a whole logical CPU would only keep replicas off small machines.
    ray_actor_options={"num_cpus": 0.1},
    # A line per request costs more than the policy; below this level Serve makes one all the same and drops it (5%).
    logging_config={"enable_access_log": False, "log_level": "WARNING"},
    # A replica that hangs is gone after three checks in vain, 8 s at most; Serve's own 30 s a check would be minutes.
    # HAProxy leaves it alone before that, after two of its own (`haproxy/configuration.py`). It has no end in order:
    # RAY_SERVE_FORCE_STOP_UNHEALTHY_REPLICAS.
    health_check_period_s=1,
    health_check_timeout_s=2,
    graceful_shutdown_timeout_s=15,  # streams are closed with a code at its beginning, and cut at its end
    user_config={},
    max_surge_percent=100,  # a rolling update starts the new replica before the old one stops
)
@serve.ingress()
class PolicyServer(InferenceService):
    """A replica: the policies, the HTTP application and the gRPC methods over them."""

    def __init__(self, places: list[str], settings: dict[str, Any], single: bool = False) -> None:
        """Check the settings. Serve calls `reconfigure` next, and sends requests only after that."""
        self._settings = ServerSettings(**settings)
        context = serve.get_replica_context()
        self._replica = context.replica_tag
        self._id = context.replica_id.deployment_id
        self._core: Core | None = None
        self._app: PolicyApp | None = None
        self._direct: DirectServer | None = None
        self._watch: asyncio.Task[None] | None = None
        self._poll: asyncio.Task[None] | None = None
        self._load = Load()
        try:
            configure(self._settings, replica=self._replica)
            self._host = _listening_host()
            check_exposure(self._host, self._settings)
            loader = version_loader(places, self._settings)
        except RlservoError as error:
            raise _plain(error) from None
        place = (_controller()._actor_id.hex(), context.app_name, context.deployment)
        self._records = None if single else GcsRecords(*place)
        self._control = ReplicaVersions(
            loader,
            GcsLedger(*place),
            replica=self._replica,
            broadcast=self._tell_all,
            gather=self._ask_all,
            is_current=self._is_current,
        )

    def __serve_build_asgi_app__(self) -> PolicyApp:  # Serve's hook: the app is built in the replica
        app = create_app(
            lambda: self._control.store,
            self._settings,
            replica=self._replica,
            control=self._control,
            host=self._host,
        )
        core: Core = app.state.core
        self._core, self._app = core, app
        core.admission.loop_clock.start()
        if self._records is not None:
            core.share_sessions(self._records, ReplicaPeers(self._id, "answer_peer", self._running))
        # By way of the module: Serve pickles this class with copies of the objects that it names.
        http_connections.leave_time_for_bodies(self._settings.body_timeout_s)
        answers = self._settings.ahead_of_serve and _can_bypass_serve()
        ingress.bypass.install(app, answers=answers)
        self.serve_grpc(core, local_only=is_loopback(self._host))
        if answers:
            grpc_ingress.bypass.install(self._grpc.answer)
        return app

    async def reconfigure(self, user_config: Any) -> None:
        """Serve what the configuration says: Serve calls this at the start, and on `serve deploy` with another one.

        Serve sends a replica nothing while this runs, so only the first call waits until all is loaded.
        """
        if self._control.store is None:
            try:
                await self._control.configure(user_config)
            except RlservoError as error:
                raise _plain(error) from None
            self._watch = asyncio.create_task(self._control.poll_ledger())
            if self._settings.poll_s is not None:
                self._poll = asyncio.create_task(self._control.poll_repository(self._settings.poll_s))
            self._sweep = asyncio.create_task(self._sweep_records())
            # What is there by now stays, and most of it is Ray's: a collection that walks it holds requests up.
            gc.collect()
            gc.freeze()
            gc.set_threshold(700, 10, 10)  # Python's own: `lean_imports.py` raised it, and rare collections are long
            self._listen_directly()
        else:
            self._reconfiguring = asyncio.create_task(self._configure(user_config))

    def _listen_directly(self) -> None:
        """Listen on the direct port, if there is one, and offer it. Raises RuntimeError."""
        port, app = self._settings.direct_port, self._app
        if port is None or app is None:
            return
        try:
            listener, is_shared = direct_port.open_port(self._host, port)
        except RlservoError as error:
            raise _plain(error) from None
        self._direct = DirectServer(app, listener, self._settings, is_shared=is_shared)
        self._direct.start()
        if (offer := make_offer(self._host, port)) is not None:
            app.offer = ((OFFER.encode(), offer.encode()),)

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Tell Serve's autoscaler how busy this replica is, for `autoscaling.by_load`."""
        return {BUSY: self._load.measure()}

    async def check_health(self) -> None:
        """Tell Serve's controller that the event loop turns and the policies are there; if not, it replaces us."""
        await asyncio.sleep(0)
        if self._control.store is None:
            raise RuntimeError("no policies are loaded: the deployment's user_config must be a map, and not null")

    async def follow_plan(self, generation: int) -> ReplicaProgress:
        """Serve a plan that another replica wrote; replicas call this of each other."""
        return await self._control.follow(generation)

    async def describe(self) -> dict[str, Any]:
        """Return this replica's listing; replicas call this of each other."""
        return {} if self._core is None else listing.describe(self._core)

    async def count(self, name: str) -> dict[str, Any]:
        """Return what this replica counted of a policy; replicas call this of each other."""
        return {} if self._core is None else listing.count(self._core, name)

    async def answer_peer(self, method: str, *arguments: Any) -> Any:
        """Take a step of a session for another replica; replicas call this of each other."""
        return None if self._core is None else await self._core.answer_peer(method, *arguments)

    async def __del__(self) -> None:
        """Answer the direct port's last requests, hand sessions over and end the recording.

        Serve calls this when the replica has answered its last request of Serve's.
        """
        if (direct := getattr(self, "_direct", None)) is not None:
            await direct.drain()
        core = getattr(self, "_core", None)
        if core is not None and core.shared_sessions is not None:
            await core.shared_sessions.hand_over()
        if core is not None and core.recorder is not None:
            core.recorder.close()

    async def _running(self) -> list[str]:
        return [str(each["replica"]) for each in await self._ask_all() if each]

    async def _sweep_records(self) -> None:
        while self._core is not None and self._core.shared_sessions is not None:
            await asyncio.sleep(SWEEP_PERIOD_S)
            try:
                await self._core.shared_sessions.sweep()
            except Exception as error:  # the next one may do
                logger.warning("records of sessions could not be looked at: %s", error)

    async def _configure(self, user_config: Any) -> None:
        try:
            await self._control.configure(user_config)
        except Exception:
            logger.exception("the configuration could not be looked at; what ran before goes on")

    async def _is_current(self, user_config: Any) -> bool:
        """Whether the controller means this configuration, or already another one.

        Serve starts a replica with what held when it was scheduled, and reconfigures it later (ray 2.60).
        """
        try:
            current = await _controller().get_deployment_config.remote(self._id)
        except RayError:  # the controller is coming back: nobody says otherwise
            return True
        return current is None or current.user_config == user_config

    async def _tell_all(self, generation: int) -> list[ReplicaProgress]:
        replies = await self._call_all("follow_plan", generation)
        return [reply for reply in replies if isinstance(reply, ReplicaProgress)]

    async def _ask_all(self, *name: str) -> list[Any]:
        replies = await self._call_all("count" if name else "describe", *name)
        return sorted(replies, key=lambda reply: str(reply.get("replica")))

    async def _call_all(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of every running replica. Raises PartlyAppliedError when one of them does not answer."""
        handle: Any = serve.get_deployment_handle(self._id.name, self._id.app_name)
        try:
            replies = await handle.broadcast(method, *arguments).results_async(
                timeout_s=FOLLOW_TIMEOUT_S, return_exceptions=True
            )
        except TimeoutError:
            raise PartlyAppliedError(f"not every replica answered within {FOLLOW_TIMEOUT_S:g} s") from None
        failures = [
            reply for reply in replies if isinstance(reply, BaseException) and not isinstance(reply, ActorDiedError)
        ]
        if failures:
            raise PartlyAppliedError(
                f"{len(failures)} of {len(replies)} replicas failed to answer: {failures[0]!s:.200}"
            )
        return [reply for reply in replies if not isinstance(reply, BaseException)]


def _plain(error: RlservoError) -> RuntimeError:
    """Ray pickles what a constructor raises and prints its text: one sentence instead of our class and details."""
    return RuntimeError(error.message)


def _controller() -> Any:
    """Return Serve's controller, which knows more than Serve's interface tells (ray 2.60)."""
    return ray_parts.find("ray.serve.context:_get_global_client")()._controller


def _can_bypass_serve() -> bool:
    """Whether Serve's handling of a request can be left out: where Serve traces, it is to see every request.

    A replica that stops then waits for its HTTP server alone, as ray 2.60's does; one that does not is asked.
    """
    if not ray_parts.is_there("ray.serve._private.replica:Replica._stop_accepting_direct_ingress"):
        return False
    return not ray_parts.find("ray.serve._private.tracing_utils:is_tracing_enabled")()


def _listening_host() -> str:
    """Return the address that Serve's HTTP options name; it is where this replica's own port listens, too."""
    options: Any = ray.get(_controller().get_http_config.remote())
    return str(options.host)


def start(
    policies: list[str],
    *,
    host: str,
    port: int,
    grpc_port: int | None,
    replicas: int,
    served: dict[str, Any],
    settings: dict[str, Any],
) -> None:
    """Start Serve in the connected Ray cluster and return when requests are answered."""
    # Without a port Serve's fallback proxy would listen all the same, where there is a service.
    services = [] if grpc_port is None else [GRPC_SERVICE]
    grpc_options = gRPCOptions(port=grpc_port or 0, grpc_servicer_functions=services, enable_reflection=False)
    app = build(
        BuildArguments(policies=policies, replicas=replicas, served=served, single=replicas == 1, settings=settings)
    )
    # `serve.start` returns when the proxies answer. The replicas start meanwhile: a second less on two cores.
    with ThreadPoolExecutor(1) as pool:
        proxies = pool.submit(serve.start, http_options=HTTPOptions(host=host, port=port), grpc_options=grpc_options)
        find_client = ray_parts.find("ray.serve.context:_get_global_client")
        while not proxies.done() and find_client(raise_if_no_controller_running=False) is None:
            time.sleep(0.02)
        if proxies.done():
            proxies.result()  # raises what kept them from starting
        serve.run(app, name=APPLICATION, route_prefix="/", _local_testing_mode=False)
        proxies.result()
    _wait_until_answered(host, port)


def _wait_until_answered(host: str, port: int) -> None:
    """Return when new connections reach a replica, several in a row. Raises UnavailableError.

    Serve takes a proxy for ready when it knows the replicas that it has heard of so far, which may be none, and a
    HAProxy that another one replaced may still take a last connection.
    """
    in_a_row, until = 0, time.monotonic() + ANSWER_TIMEOUT_S
    while in_a_row < ANSWERED:
        answer = ""
        try:
            with closing(http.client.HTTPConnection(EVERYWHERE.get(host, host), port, timeout=5)) as connection:
                connection.request("GET", "/healthz")
                status = connection.getresponse().status
        except (OSError, http.client.HTTPException) as error:
            status, answer = 0, repr(error)
        if status in (200, 429):  # 429: the proxy counts the last connection still, of the few that an address may have
            in_a_row += 1
            continue
        in_a_row = 0
        if time.monotonic() > until:
            raise UnavailableError(
                f"the replicas run, but after {ANSWER_TIMEOUT_S:g} s the proxy at {host}:{port} still answers "
                f"{answer or status} to GET /healthz"
            )
        time.sleep(0.05)
