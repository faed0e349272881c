"""Everything `tritonclient[http]` can ask of the server, by the unchanged client in an environment of its own.

python triton_http.py HOST:PORT < {"obs": [[...], ...]}   prints the replies, as JSON.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import tritonclient.http as triton
import tritonclient.http.aio as triton_aio
from tritonclient.utils import InferenceServerException

MODEL = "ur5"


def tensor(obs: Any, *, binary: bool = True, kind: Any = triton) -> list[Any]:
    given = kind.InferInput("obs", list(obs.shape), "FP32")
    given.set_data_from_numpy(obs, binary_data=binary)
    return [given]


def wanted(binary: bool) -> list[Any]:
    return [triton.InferRequestedOutput("action", binary_data=binary)]


def refusal(call: Callable[[], object]) -> list[str] | None:
    try:
        call()
    except InferenceServerException as error:
        return [error.status(), error.message()]
    return None


async def over_aio(url: str, obs: Any) -> dict[str, Any]:
    async with triton_aio.InferenceServerClient(url) as client:
        ready = await client.is_model_ready(MODEL)
        plain = await client.infer(MODEL, tensor(obs, kind=triton_aio))
        packed = await client.infer(
            MODEL,
            tensor(obs, kind=triton_aio),
            request_compression_algorithm="gzip",
            response_compression_algorithm="deflate",
        )
        return {"ready": ready, "plain": plain.as_numpy("action"), "packed": packed.as_numpy("action")}


def as_perf_analyzer_asks(client: Any, obs: Any) -> dict[str, Any]:
    """Its requests, in order: the model, how it is run, and its counts before and after the requests."""
    model, config = client.get_model_metadata(MODEL, "2"), client.get_model_config(MODEL, "2")
    before = client.get_inference_statistics(MODEL, "2")
    for _ in range(3):
        client.infer(MODEL, tensor(obs[:1]), model_version="2")
    client.infer(MODEL, tensor(obs), model_version="2")
    refusal(lambda: client.infer(MODEL, tensor(obs[:, :26]), model_version="2"))
    after = client.get_inference_statistics(MODEL, "2")
    return {
        "model": model,
        "config": config,
        "before": before,
        "after": after,
        "all": client.get_inference_statistics(),
    }


def main() -> None:
    url = sys.argv[1]
    obs = np.array(json.load(sys.stdin)["obs"], np.float32)
    with triton.InferenceServerClient(url, concurrency=4) as client:
        actions = {
            f"{send}-{receive}": client.infer(
                MODEL, tensor(obs, binary=send == "binary"), outputs=wanted(receive == "binary")
            ).as_numpy("action")
            for send in ("binary", "json")
            for receive in ("binary", "json")
        }
        actions["default"] = client.infer(MODEL, tensor(obs)).as_numpy("action")
        for packing in ("gzip", "deflate"):
            for binary in (True, False):
                actions[f"{packing}-{binary}"] = client.infer(
                    MODEL,
                    tensor(obs, binary=binary),
                    outputs=wanted(binary),
                    request_compression_algorithm=packing,
                    response_compression_algorithm=packing,
                ).as_numpy("action")
        pending = [client.async_infer(MODEL, tensor(obs)) for _ in range(8)]
        for number, request in enumerate(pending):
            actions[f"async-{number}"] = request.get_result().as_numpy("action")
        older = client.infer(MODEL, tensor(obs), model_version="2", request_id="r-7", parameters={"seq": 5})
        facts = {
            "live": client.is_server_live(),
            "ready": client.is_server_ready(),
            "model_ready": [
                client.is_model_ready(MODEL),
                client.is_model_ready(MODEL, "2"),
                client.is_model_ready("nobody"),
                client.is_model_ready(MODEL, "99"),
            ],
            "server": client.get_server_metadata(),
            "model": client.get_model_metadata(MODEL),
            "version": client.get_model_metadata(MODEL, "2"),
            "index": client.get_model_repository_index(),
            "older": older.get_response(),
            "measured": as_perf_analyzer_asks(client, obs),
            "unknown": refusal(lambda: client.infer("nobody", tensor(obs))),
            "short": refusal(lambda: client.infer(MODEL, tensor(obs[:, :26]))),
            "nan": refusal(lambda: client.infer(MODEL, tensor(np.full((1, 27), np.nan, np.float32)))),
            "late": refusal(lambda: client.infer(MODEL, tensor(obs), parameters={"deadline_ms": 1e-6})),
        }
        actions["older"] = older.as_numpy("action")
    aio = asyncio.run(over_aio(url, obs))
    actions.update({"aio": aio["plain"], "aio-packed": aio["packed"]})
    facts["aio_ready"] = aio["ready"]
    facts["dtypes"] = sorted({str(action.dtype) for action in actions.values()})
    facts["actions"] = {name: action.tolist() for name, action in actions.items()}
    json.dump(facts, sys.stdout)


if __name__ == "__main__":
    main()
