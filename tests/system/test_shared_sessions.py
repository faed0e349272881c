"""LSTM sessions over several processes with one Redis: killed, stopped and abandoned, and every action bit for bit."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from clusters import KEY, RECURRENT, Cluster
from servers import launched
from session_players import MODEL, GrpcConnection, HttpConnection, Tally, play
from storages import RedisServer

pytestmark = [pytest.mark.serve, pytest.mark.slow]

SESSIONS = 200


def connections(port: int, grpc_port: int, key: str = "") -> list[HttpConnection | GrpcConnection]:
    """Return a connection for each session: JSON, and the Open Inference Protocol over HTTP and gRPC."""
    return [
        GrpcConnection(grpc_port, key=key) if number % 3 == 2 else HttpConnection(port, is_oip=number % 3 == 1, key=key)
        for number in range(SESSIONS)
    ]


def check(tally: Tally) -> None:
    print(tally)
    assert tally.wrong == []
    assert tally.given_up > 0


def test_every_action_is_the_policys_own_over_three_workers(redis_server: RedisServer, recurrent: Path) -> None:
    settings = {"session_store": redis_server.url}
    with launched(recurrent, workers=3, with_grpc=True, settings=settings) as run:
        run.wait_until_ready()
        assert run.grpc_port is not None
        asked = connections(run.port, run.grpc_port)
        check(asyncio.run(play(asked, recurrent / MODEL, lambda: run.processes("spawn_main"), rest=400)))


def test_every_action_is_the_policys_own_over_two_replicas_of_ray_serve(cluster: Cluster) -> None:
    asked = connections(cluster.port, cluster.grpc_port, KEY)
    bundle = cluster.repository / RECURRENT
    check(asyncio.run(play(asked, bundle, cluster.replica_pids, rest=300)))
