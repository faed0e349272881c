"""Sequences as `tritonclient` keeps them, over all its transports, in an environment of its own.

python triton_sequences.py HTTP_HOST:PORT GRPC_HOST:PORT MODEL KEY < {"obs": [[...], ...]}

prints the actions, as JSON.
Each transport plays two interleaved sequences; the second one starts a step later, and sees the observations backwards.
"""

from __future__ import annotations

import asyncio
import json
import queue
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import tritonclient.grpc as triton_grpc
import tritonclient.grpc.aio as triton_grpc_aio
import tritonclient.http as triton_http
import tritonclient.http.aio as triton_http_aio
from tritonclient.utils import InferenceServerException

Step = tuple[int, Any, dict[str, Any]]  # (which sequence, observation, Triton's options)


def steps(obs: Any, first: Any, second: Any) -> Iterator[Step]:
    last = len(obs) - 1
    for turn in range(len(obs) + 1):
        for which, name, step in ((0, first, turn), (1, second, turn - 1)):
            if 0 <= step <= last:
                options = {"sequence_id": name, "sequence_start": step == 0, "sequence_end": step == last}
                yield which, obs[step if which == 0 else last - step], options


def tensor(kind: Any, obs: Any) -> list[Any]:
    given = kind.InferInput("obs", [1, len(obs)], "FP32")
    given.set_data_from_numpy(obs[None])
    return [given]


def keyed(key: str) -> dict[str, str]:
    """Return the headers of one request: the HTTP client writes its own into what it is given."""
    return {"authorization": f"Bearer {key}"}


def play(obs: Any, ids: tuple[Any, Any], ask: Callable[[Any, dict[str, Any]], Any]) -> list[list[Any]]:
    actions: list[list[Any]] = [[], []]
    for which, seen, options in steps(obs, *ids):
        actions[which].append(ask(seen, options).as_numpy("action")[0].tolist())
    return actions


async def play_aio(obs: Any, ids: tuple[Any, Any], kind: Any, url: str, model: str, key: str) -> list[list[Any]]:
    actions: list[list[Any]] = [[], []]
    async with kind.InferenceServerClient(url) as client:
        for which, seen, options in steps(obs, *ids):
            reply = await client.infer(model, tensor(kind, seen), **options, headers=keyed(key))
            actions[which].append(reply.as_numpy("action")[0].tolist())
    return actions


def play_stream(obs: Any, ids: tuple[Any, Any], client: Any, model: str, key: str) -> list[list[Any]]:
    """Send everything at once on one stream, and read afterwards: replies come in the order of requests."""
    replies: queue.Queue[Any] = queue.Queue()
    client.start_stream(partial(lambda q, result, error: q.put((result, error)), replies), headers=keyed(key))
    sent = list(steps(obs, *ids))
    for number, (_, seen, options) in enumerate(sent):
        client.async_stream_infer(model, tensor(triton_grpc, seen), request_id=str(number), **options)
    actions: list[list[Any]] = [[], []]
    for number, (which, _, _) in enumerate(sent):
        result, error = replies.get(timeout=30)
        if error is not None or result.get_response().id != str(number):
            raise SystemExit(f"reply {number}: {error or result.get_response().id}")
        actions[which].append(result.as_numpy("action")[0].tolist())
    client.stop_stream()
    return actions


def main() -> None:
    http_url, grpc_url, model, key = sys.argv[1:5]
    obs = np.array(json.load(sys.stdin)["obs"], np.float32)
    out: dict[str, Any] = {}
    with triton_http.InferenceServerClient(http_url) as http, triton_grpc.InferenceServerClient(grpc_url) as grpc:

        def over_http(seen: Any, options: dict[str, Any]) -> Any:
            return http.infer(model, tensor(triton_http, seen), **options, headers=keyed(key))

        def over_http_async(seen: Any, options: dict[str, Any]) -> Any:
            return http.async_infer(model, tensor(triton_http, seen), **options, headers=keyed(key)).get_result()

        def over_grpc(seen: Any, options: dict[str, Any]) -> Any:
            return grpc.infer(model, tensor(triton_grpc, seen), **options, headers=keyed(key))

        def over_grpc_async(seen: Any, options: dict[str, Any]) -> Any:
            replies: queue.Queue[Any] = queue.Queue()
            put = partial(lambda q, result, error: q.put((result, error)), replies)
            grpc.async_infer(model, tensor(triton_grpc, seen), put, **options, headers=keyed(key))
            result, error = replies.get(timeout=30)
            if error is not None:
                raise error
            return result

        out["http"] = play(obs, (11, "eleven"), over_http)
        out["http async"] = play(obs, (12, "twelve"), over_http_async)
        out["grpc"] = play(obs, (11, "eleven"), over_grpc)  # ended above, and begun again here
        out["grpc async"] = play(obs, (14, "14"), over_grpc_async)  # two sequences
        out["stream"] = play_stream(obs, (15, "fifteen"), grpc, model, key)
        refusals = []
        for ask in (over_http, over_grpc):
            for options in ({"sequence_id": 99}, {"sequence_id": 11}):  # never begun; ended
                try:
                    ask(obs[0], options)
                    refusals.append("")
                except InferenceServerException as error:
                    refusals.append(error.message())
        out["refusals"] = refusals
    out["http aio"] = asyncio.run(play_aio(obs, (16, "sixteen"), triton_http_aio, http_url, model, key))
    out["grpc aio"] = asyncio.run(play_aio(obs, (17, "seventeen"), triton_grpc_aio, grpc_url, model, key))
    print(json.dumps(out))


if __name__ == "__main__":
    main()
