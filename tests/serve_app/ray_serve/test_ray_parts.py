"""Private names of Ray and grpcio: a library that lacks one is refused by version, or what it saved is done without."""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path
from typing import Any

import grpc
import pytest
import ray

from rlservo.serve_app.ray_serve import cluster_process, grpc_ingress, ray_parts, uvicorn_parts
from rlservo.serve_app.ray_serve.ray_parts import FIELDS, NEEDED, SPARED

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ray.serve's use of pydantic
    from rlservo.serve_app.ray_serve import app

OPERATIONS = Path(__file__).resolve().parents[3] / "docs" / "operations.md"


def take_away(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ray_parts.check()  # imports all of them: one that is imported without the other's name would itself be missing
    module, _, attributes = name.partition(":")
    *owners, last = attributes.split(".")
    owner = ray_parts.find(f"{module}:{'.'.join(owners)}") if owners else importlib.import_module(module)
    monkeypatch.delattr(owner, last)


def test_the_installed_ray_has_every_name() -> None:
    ray_parts.check()
    assert [name for name in SPARED if not ray_parts.is_there(name)] == []


@pytest.mark.parametrize("name", NEEDED)
def test_a_ray_that_lacks_a_needed_name_is_refused_by_version(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    take_away(name, monkeypatch)
    with pytest.raises(RuntimeError) as refusal:
        ray_parts.check()
    assert ray.__version__ in str(refusal.value) and name.replace(":", ".") in str(refusal.value)
    with pytest.raises(RuntimeError, match="install a Ray that it knows"):
        app.build(app.BuildArguments.model_validate({"policies": ["somewhere"]}))


@pytest.mark.parametrize("name", FIELDS)
def test_so_is_one_whose_objects_lack_a_needed_field(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def initialize(self: Any, controller: Any) -> None:
        self._controller_handle = controller

    monkeypatch.setattr(ray_parts.find(name.rpartition(".")[0]), "__init__", initialize)
    with pytest.raises(RuntimeError) as refusal:
        ray_parts.check()
    assert ray.__version__ in str(refusal.value) and name.replace(":", ".") in str(refusal.value)


def test_so_is_a_uvicorn_that_lacks_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(uvicorn_parts.RequestResponseCycle, "run_asgi")
    with pytest.raises(RuntimeError, match=r"uvicorn .* has no RequestResponseCycle\.run_asgi, "):
        app.build(app.BuildArguments.model_validate({"policies": ["somewhere"]}))


def test_so_is_one_that_lacks_a_whole_module() -> None:
    with pytest.raises(RuntimeError, match=r"has no ray\.serve\._private\.elsewhere\.name, which"):
        ray_parts.find("ray.serve._private.elsewhere:name")


def test_without_the_switches_of_what_nobody_uses_everything_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    services: Any = importlib.import_module("ray._private.services")
    started: list[list[str]] = []
    monkeypatch.setattr(services, "start_ray_process", lambda command, *_, **__: started.append(command))
    for name in SPARED[1:]:
        take_away(name, monkeypatch)
    ray_parts.check()
    cluster_process.leave_out_extras()
    services.start_ray_process(["gcs_server"], "gcs_server")
    assert started == [["gcs_server"]]


def test_the_raylet_is_looked_for_until_it_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    services: Any = importlib.import_module("ray._private.services")
    looks: list[dict[Any, str]] = [{}, {}, {bytes.fromhex("a1"): "another"}, {bytes.fromhex("b2"): "this one"}]

    class Client:
        def __init__(self, address: str) -> None:
            assert address == "127.0.0.1:1"

        def get_all_node_info(self, timeout: float) -> dict[Any, str]:
            return looks.pop(0)

    monkeypatch.setattr("ray._raylet.GcsClient", Client)
    monkeypatch.setattr(services, "get_node", lambda address, node: (address, node, len(looks)))
    cluster_process._poll_for_node()
    assert services.get_node("127.0.0.1:1", "b2") == ("127.0.0.1:1", "b2", 0)  # Ray's own look comes last


def test_serve_handles_every_request_where_its_replicas_do_not_wait_for_their_http_servers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert app._can_bypass_serve()
    take_away(SPARED[0], monkeypatch)
    assert not app._can_bypass_serve()


def test_serve_handles_every_request_where_it_traces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ray.serve._private.tracing_utils.is_tracing_enabled", lambda: True)
    assert not app._can_bypass_serve()


def test_a_grpcio_that_keeps_methods_elsewhere_is_refused_by_version(monkeypatch: pytest.MonkeyPatch) -> None:
    class Server:
        def add_generic_rpc_handlers(self, handlers: Any) -> None:
            assert handlers == (service,)

    service = object()
    monkeypatch.setattr(grpc, "method_handlers_generic_handler", lambda *_: service)
    with pytest.raises(RuntimeError, match=f"grpcio {grpc.__version__} keeps a service's methods in another way"):
        grpc_ingress.add_service(None, Server())


def test_the_documents_table_has_every_name() -> None:
    table = OPERATIONS.read_text().partition("## What must change for the next Ray")[2]
    missing = [
        name for name in (*NEEDED, *FIELDS, *SPARED) if f"`{name.rpartition(':')[2].rpartition('.')[2]}`" not in table
    ]
    assert not missing
