"""The policy server as a Ray Serve application. The one file that imports ray.serve.

One deployment holds every policy: a policy is kilobytes and microseconds, a hop to another actor is milliseconds.
From a checkout: `serve run deploy/serve.yaml`, or `serve run rlservo.serve_app.app:build policies=DIR`. `rlservo serve`
comes here through `cluster.py`. A replica imports neither torch nor ray.rllib.
"""

# No `from __future__ import annotations` here: Serve reads the type of build's argument to know what to make of `args`.

import asyncio
from pathlib import Path
from typing import Any, cast

import ray
from fastapi import FastAPI
from pydantic import BaseModel, ConfigDict, Field, field_validator
from ray import serve
from ray.serve import Application, Deployment
from ray.serve.config import HTTPOptions
from ray.serve.context import _get_global_client

from rlservo.export.errors import RlservoError
from rlservo.serve_app.http import create_app
from rlservo.serve_app.keys import check_exposure
from rlservo.serve_app.settings import ServerSettings
from rlservo.serve_app.store import PolicyStore

APPLICATION = "rlservo"
DEPLOYMENT = "PolicyServer"


class BuildArguments(BaseModel):
    """The `args` of an application in serve.yaml, or `key=value` after `serve run`."""

    model_config = ConfigDict(extra="forbid")

    policies: list[str] = Field(min_length=1)
    """Bundle folders, policy folders or repositories; on the command line separated by commas."""

    replicas: int = Field(1, ge=1)
    """Processes that serve the same policies; each loads all of them."""

    settings: dict[str, Any] = {}
    """Fields of ServerSettings; what is not given comes from RLSERVO_* variables, then from the defaults."""

    @field_validator("policies", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return value.split(",") if isinstance(value, str) else value


def build(args: BuildArguments) -> Application:
    """Return the application for `serve run`, `serve deploy` and `rlservo serve`.

    Relative folders are taken from the directory this runs in, since a replica's own is another. Raises UsageError.
    """
    settings = ServerSettings.from_environment(args.settings)
    # A folder may exist only on the nodes that run replicas, so it is the replica that looks.
    folders = [str(Path(folder).expanduser().absolute()) for folder in args.policies]
    server: Deployment = cast("Deployment", PolicyServer)  # the decorator's type says it is still the class
    options = server.options(num_replicas=args.replicas, max_ongoing_requests=settings.max_ongoing_requests)
    return options.bind(folders, settings.model_dump())


@serve.deployment(
    name=DEPLOYMENT,
    # A policy server spends its time waiting; a whole logical CPU would only keep replicas off small machines.
    ray_actor_options={"num_cpus": 0.1},
    # A line per request costs more than the policy; below this level Serve makes one all the same and drops it (5%).
    logging_config={"enable_access_log": False, "log_level": "WARNING"},
    health_check_period_s=5,
    graceful_shutdown_timeout_s=5,
)
@serve.ingress()
class PolicyServer:
    """A replica: the policies, and the HTTP application over them."""

    def __init__(self, folders: list[str], settings: dict[str, Any]) -> None:
        """Load and prove every policy; Serve sends requests only after this has returned."""
        self._settings = ServerSettings(**settings)
        try:
            check_exposure(_listening_host(), self._settings)
            self._store = PolicyStore.load(folders, threads=self._settings.threads)
        except RlservoError as error:
            # Ray pickles what a constructor raises and prints its text: one sentence instead of our class and details.
            raise RuntimeError(error.message) from None

    def __serve_build_asgi_app__(self) -> FastAPI:  # Serve's hook: the app is built in the replica
        return create_app(lambda: self._store, self._settings, replica=serve.get_replica_context().replica_tag)

    async def check_health(self) -> None:
        """Tell Serve's controller that the event loop turns and the policies are there; if not, it replaces us."""
        await asyncio.sleep(0)
        if not self._store.names:
            raise RuntimeError("no policies are loaded")


def _listening_host() -> str:
    """Return the address that Serve's HTTP options name; it is where this replica's own port listens, too.

    Serve tells its replicas, and nobody else (ray 2.60): hence the private client.
    """
    client: Any = _get_global_client()
    options: Any = ray.get(client._controller.get_http_config.remote())
    return str(options.host)


def start(policies: list[str], *, host: str, port: int, replicas: int, settings: dict[str, Any]) -> None:
    """Start Serve in the connected Ray cluster and return when requests are answered."""
    serve.start(http_options=HTTPOptions(host=host, port=port))
    app = build(BuildArguments(policies=policies, replicas=replicas, settings=settings))
    serve.run(app, name=APPLICATION, route_prefix="/", _local_testing_mode=False)


def stop() -> None:
    """Shut Serve down: proxies first, then replicas, then the controller."""
    serve.shutdown()
