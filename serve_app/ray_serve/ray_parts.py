"""Ray's private names that the server needs, looked up in one place: where one is gone, the start is refused by name.

docs/operations.md, "What must change for the next Ray", says for each what it is for. A name is written
`module:attribute`. It imports little of its own: Serve's proxies import it.
"""

from __future__ import annotations

import importlib
from functools import reduce
from typing import Any

KNOWN = "2.60"
"""The Ray these names are of."""

KEY_VALUE_STORE = "ray.experimental.internal_kv"
GCS_CLIENT = f"{KEY_VALUE_STORE}:internal_kv_get_gcs_client"
PICKLE = "ray.cloudpickle:dumps"
REPLICA_ID = "ray.serve._private.common:ReplicaID"
REQUEST_METADATA = "ray.serve._private.common:RequestMetadata"
NEEDED = (
    "ray.serve.context:_get_global_client",
    "ray.actor:ActorHandle._actor_id",
    "ray.serve._private.controller:ServeController.get_http_config",
    "ray.serve._private.controller:ServeController.get_deployment_config",
    *(f"{KEY_VALUE_STORE}:_internal_kv_{verb}" for verb in ("get", "put", "list", "del")),
    GCS_CLIENT,
    "ray._raylet:InnerGcsClient",
    f"{REPLICA_ID}.to_full_id_str",
    REQUEST_METADATA,
    "ray.serve._private.replica:ReplicaActor.handle_request",
    "ray.serve._private.constants:RAY_SERVE_ENABLE_HA_PROXY",
    "ray.serve._private.default_impl:add_grpc_address",
    "ray.serve._private.grpc_util:gRPCGenericServer._override_method_handler",
    "ray.serve._private.http_util:socket",
    "ray.serve._private.replica:add_port_to_grpc_server",
    "ray.serve._private.tracing_utils:is_tracing_enabled",
    "ray._private.node:Node.dead_processes",
    "ray._private.services:start_ray_process",
    "ray._private.worker:_global_node",
)
FIELDS = ("ray.serve._private.client:ServeControllerClient._controller",)
"""As needed, and set by their class's `__init__`: of an object there is none when the start is checked."""
SPARED = (
    "ray.serve._private.replica:Replica._stop_accepting_direct_ingress",
    "ray._private.parameter:RayParams",
    "ray._private.services:start_api_server",
    "ray._private.utils:get_dashboard_dependency_error",
    "ray._private.services:get_node",
)
"""Without one of these the server is slower or larger, and as correct."""


def find(name: str) -> Any:
    """Return what a name stands for. Raises RuntimeError where this Ray has no such thing."""
    module, _, attributes = name.partition(":")
    try:
        return reduce(getattr, attributes.split(".") if attributes else [], importlib.import_module(module))
    except (ImportError, AttributeError):
        raise _refusal(name) from None


def is_there(name: str) -> bool:
    """Whether this Ray has what a name stands for."""
    try:
        find(name)
    except RuntimeError:
        return False
    return True


def check() -> None:
    """Raise RuntimeError where this Ray lacks a name that is needed."""
    for name in NEEDED:
        find(name)
    for name in FIELDS:
        kind, _, field = name.rpartition(".")
        if field not in vars(find(kind))["__init__"].__code__.co_names:
            raise _refusal(name)


def _refusal(name: str) -> RuntimeError:
    import ray

    return RuntimeError(
        f"Ray {ray.__version__} has no {name.replace(':', '.')}, which this version of rlservo uses: install a Ray "
        f"that it knows, such as {KNOWN}"
    )
