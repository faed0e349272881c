"""Everything `tritonclient[grpc]` can ask of the server, by the unchanged client in an environment of its own.

python triton_grpc.py HOST:PORT KEY < {"obs": [[...], ...]}   prints the replies, as JSON.
"""

from __future__ import annotations

import asyncio
import json
import queue
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import tritonclient.grpc as triton
import tritonclient.grpc.aio as triton_aio
from tritonclient.utils import InferenceServerException

MODEL = "ur5"


def tensor(obs: Any, kind: Any = triton) -> list[Any]:
    given = kind.InferInput("obs", list(obs.shape), "FP32")
    given.set_data_from_numpy(obs)
    return [given]


def refusal(call: Callable[[], object]) -> list[str] | None:
    try:
        call()
    except InferenceServerException as error:
        return [error.status(), error.message()]
    return None


async def over_aio(url: str, headers: dict[str, str], obs: Any) -> dict[str, Any]:
    async with triton_aio.InferenceServerClient(url) as client:
        ready = await client.is_model_ready(MODEL, headers=headers)
        replies = await asyncio.gather(*(client.infer(MODEL, tensor(obs), headers=headers) for _ in range(8)))
        return {"ready": ready, "actions": [reply.as_numpy("action").tolist() for reply in replies]}


def over_stream(client: Any, headers: dict[str, str], obs: Any) -> list[Any]:
    """Three requests on one stream, of which the second is wrong."""
    replies: queue.Queue[Any] = queue.Queue()
    client.start_stream(partial(lambda q, result, error: q.put((result, error)), replies), headers=headers)
    for sent, name in ((obs, "a"), (obs[:, :3], "b"), (obs, "c")):
        client.async_stream_infer(MODEL, tensor(sent), request_id=name)
    got = []
    for _ in range(3):
        result, error = replies.get(timeout=20)
        got.append(str(error) if error else [result.get_response().id, result.as_numpy("action").tolist()])
    client.stop_stream()
    return got


def main() -> None:
    url, key = sys.argv[1:3]
    headers = {"authorization": f"Bearer {key}"}
    obs = np.array(json.load(sys.stdin)["obs"], np.float32)
    out: dict[str, Any] = {}
    with triton.InferenceServerClient(url) as client:
        out["live"], out["ready"] = client.is_server_live(), client.is_server_ready()  # without a key
        ask = partial(client.infer, MODEL, headers=headers)
        out["model_ready"] = [
            client.is_model_ready(MODEL, headers=headers),
            client.is_model_ready(MODEL, "2", headers=headers),
            client.is_model_ready(MODEL, "77", headers=headers),
            client.is_model_ready("nobody", headers=headers),
        ]
        out["server"] = client.get_server_metadata(headers=headers, as_json=True)
        out["model"] = client.get_model_metadata(MODEL, headers=headers, as_json=True)
        out["index"] = client.get_model_repository_index(headers=headers, as_json=True)
        out["config"] = client.get_model_config(MODEL, headers=headers, as_json=True)["config"]
        counts = partial(client.get_inference_statistics, MODEL, "2", headers=headers, as_json=True)
        out["before"] = counts()["model_stats"]
        out["all"] = client.get_inference_statistics(headers=headers, as_json=True)["model_stats"]
        reply = ask(tensor(obs), request_id="r1", outputs=[triton.InferRequestedOutput("action")])
        out["action"], out["id"] = reply.as_numpy("action").tolist(), reply.get_response().id
        out["version_2"] = ask(tensor(obs), model_version="2").as_numpy("action").tolist()
        out["after"] = counts()["model_stats"]
        for name in ("gzip", "deflate"):
            out[name] = ask(tensor(obs), compression_algorithm=name).as_numpy("action").tolist()
        explored = [ask(tensor(obs), parameters={"explore": True, "seed": 5}).as_numpy("action") for _ in range(2)]
        out["seeded"] = bool((explored[0] == explored[1]).all() and (explored[0] != reply.as_numpy("action")).any())
        done: queue.Queue[Any] = queue.Queue()
        client.async_infer(
            MODEL, tensor(obs), partial(lambda q, result, error: q.put((result, error)), done), headers=headers
        )
        result, error = done.get(timeout=20)
        out["async"] = str(error) if error else result.as_numpy("action").tolist()
        out["stream"] = over_stream(client, headers, obs)
        wrong = obs.copy()
        wrong[0, 3] = np.nan
        out["refused"] = {
            "no key": refusal(lambda: client.infer(MODEL, tensor(obs))),
            "wrong key": refusal(lambda: client.infer(MODEL, tensor(obs), headers={"authorization": "Bearer x"})),
            "shape": refusal(lambda: ask(tensor(obs[:, :3]))),
            "nan": refusal(lambda: ask(tensor(wrong))),
            "unknown": refusal(lambda: client.infer("nobody", tensor(obs), headers=headers)),
            "version": refusal(lambda: ask(tensor(obs), model_version="77")),
            "parameter": refusal(lambda: ask(tensor(obs), parameters={"speed": 3})),
            "walk": refusal(lambda: client.infer("../ur5", tensor(obs), headers=headers)),
            "late": refusal(lambda: ask(tensor(obs), timeout=1)),  # [us]
            "config": refusal(lambda: client.get_model_config("nobody", headers=headers)),
            "statistics": refusal(lambda: client.get_inference_statistics(MODEL, "77", headers=headers)),
            "config without a key": refusal(lambda: client.get_model_config(MODEL)),
        }
    out["aio"] = asyncio.run(over_aio(url, headers, obs))
    print(json.dumps(out))


if __name__ == "__main__":
    main()
