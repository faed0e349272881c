"""Counters and gauges sampled from the server's own numbers: requests, plan, queue, sessions, keys, recording, drift.

They are sampled when Prometheus asks and, where several workers share their metrics, every second.
"""

from __future__ import annotations

import asyncio
import logging

import numpy as np

from rlservo.serve_app.server.metrics import SUCCESS
from rlservo.serve_app.server.request_handler import RequestHandler

EVERY_S = 1.0
MAX_ELEMENTS = 128  # not a series for each pixel of an image: only the largest is shown
LARGEST = "largest"

logger = logging.getLogger(__name__)


async def exposition(handler: RequestHandler) -> bytes:
    """Return all metrics as Prometheus reads them."""
    sample(handler)
    return await asyncio.to_thread(handler.metrics.text)  # thousands of series take a while


async def keep_sampled(handler: RequestHandler) -> None:
    """Sample until cancelled, for the other workers to read."""
    while True:
        try:
            sample(handler)
        except Exception:  # a fault in one metric must not stop the others
            logger.exception("the metrics could not be sampled")
        await asyncio.sleep(EVERY_S)


def sample(handler: RequestHandler) -> None:
    """Bring all counters and gauges up to date."""
    for part in (requests, versions, queue, keys, recording, sessions, shadows):
        part(handler)
    handler.metrics.sampled.end_round()


def requests(handler: RequestHandler) -> None:
    """Sample the counts of requests, streams and episodes."""
    metrics, show = handler.metrics, handler.metrics.sampled
    outcomes = {(*key, "ok"): answers.count for key, answers in metrics.answers.items()} | metrics.failures
    for (policy, version, protocol, code), count in outcomes.items():
        which = {"policy": policy, "version": version, "protocol": protocol, "code": code}
        show.counter("rlservo_requests", "Requests by outcome", count, **which)
    for policy, count in metrics.streams.items():
        show.gauge("rlservo_streams", "Open WebSockets", count, policy=policy)
    for (policy, version, succeeded), count in metrics.ends.items():
        which = {"policy": policy, "version": version, "outcome": SUCCESS if succeeded else "other"}
        show.counter("rlservo_episode_ends", "Episodes whose end a client reported (`final_status`)", count, **which)


def versions(handler: RequestHandler) -> None:
    """Sample the plan that this process follows, and each version's default flag, batches and drift."""
    show = handler.metrics.sampled
    if handler.control is not None and handler.control.plan is not None:
        show.gauge("rlservo_plan_generation", "Plan that this process follows", handler.control.plan.generation)
    for name, version, policy in handler.policies():
        which, is_default = {"policy": name, "version": version}, version == handler.store().default(name)
        show.gauge("rlservo_policy_loaded", "1 for the default version, 0 for the others", is_default, **which)
        drift = policy.drift
        if drift is None:
            continue
        show.counter("rlservo_observation_looks", "Observations checked for drift", drift.looks, **which)
        elements, moved, varied = drift.elements if drift.looks else (), drift.shift, drift.spread
        if len(elements) > MAX_ELEMENTS:
            elements, moved, varied = (LARGEST,), moved[[np.argmax(np.abs(moved))]], varied[[np.argmax(varied)]]
        for element, mean, deviation in zip(elements, moved.tolist(), varied.tolist()):  # noqa: B905 - none before a look
            shift = "Shift of an observation element's mean from training's, in training's standard deviations"
            show.gauge("rlservo_observation_shift", shift, mean, **which, element=element)
            spread = "Standard deviation of an observation element, relative to training"
            show.gauge("rlservo_observation_spread", spread, deviation, **which, element=element)


def queue(handler: RequestHandler) -> None:
    """Sample the requests that wait for this process."""
    admission, show = handler.admission, handler.metrics.sampled
    waited = "Largest number of requests that waited for the processor at once, since the start"
    show.gauge("rlservo_queue_longest", waited, admission.longest)
    show.gauge("rlservo_requests_incoming", "Requests whose body is still arriving", admission.incoming)


def keys(handler: RequestHandler) -> None:
    """Sample whether the API keys in use are those of their file, and the refusals by rate limit."""
    show = handler.metrics.sampled
    current = "1 while the API keys in use are those of their file; 0 if older keys stay in use"
    show.gauge("rlservo_api_keys_current", current, handler.keys.current)
    for label, count in handler.keys.limits.refused.items():
        show.counter("rlservo_rate_limited", "Requests refused because their key exceeded its rate", count, key=label)


def recording(handler: RequestHandler) -> None:
    """Sample the recorded and missing decisions, if recording is on."""
    if handler.recorder is None:
        return
    recorder, show = handler.recorder.recorder, handler.metrics.sampled
    goes_on = "1 while decisions are recorded; 0 if the folder cannot be written"
    show.gauge("rlservo_recording", goes_on, recorder.failure is None)
    show.counter("rlservo_records_written", "Decisions and outcomes in the recording", recorder.written)
    show.counter("rlservo_records_dropped", "Decisions dropped by a full recording buffer", recorder.dropped)


def sessions(handler: RequestHandler) -> None:
    """Sample the episodes in memory."""
    episodes, kept, show = handler.episodes, handler.episodes.sessions, handler.metrics.sampled
    now = kept.count()
    for name in sorted({*now, *episodes.begun, *episodes.lost}):
        show.gauge("rlservo_sessions", "Sessions in this process", now[name], policy=name)
        show.counter("rlservo_sessions_begun", "Sessions begun", episodes.begun[name], policy=name)
        show.counter("rlservo_sessions_evicted", "Sessions forgotten when idle", kept.evicted[name], policy=name)
        show.counter("rlservo_sessions_lost", "Requests for unknown sessions", episodes.lost[name], policy=name)
    if episodes.store is not None:
        failed = "Failed reads and writes of sessions in Redis; the requests were answered with 503"
        show.counter("rlservo_session_store_failures", failed, episodes.store.unreachable)
    show.gauge("rlservo_episodes_remembered", "Episodes in memory, in sessions and on streams", kept.rows)


def shadows(handler: RequestHandler) -> None:
    """Sample the actions without a shadow's comparison."""
    for ((policy, version, shadow), reason), count in list(handler.shadows.missed.items()):
        which = {"policy": policy, "version": version, "shadow": shadow, "reason": reason}
        handler.metrics.sampled.counter("rlservo_shadow_missed", "Actions not compared with a shadow's", count, **which)
