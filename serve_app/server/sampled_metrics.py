"""Counters and gauges of a server, sampled from the request handler at scrape time; histograms: `metrics.py`."""

from __future__ import annotations

import asyncio
import time

import numpy as np

from rlservo.client.formats.request_names import SUCCESS
from rlservo.serve_app.server.request_handler import RequestHandler

MAX_ELEMENTS = 128  # not a series for each pixel of an image: only the largest is shown


async def exposition(handler: RequestHandler) -> bytes:
    """Return all metrics as Prometheus reads them."""
    await sample(handler)
    return await asyncio.to_thread(handler.metrics.text)  # thousands of series take a while


async def sample(handler: RequestHandler) -> None:
    """Bring all counters and gauges up to date."""
    for part in (requests, versions, process, sessions):
        part(handler)
    handler.metrics.end_round()


def requests(handler: RequestHandler) -> None:
    """Sample the counts of requests, streams, episodes and shadows."""
    show = handler.metrics
    for answers in show.answers.values():
        answers.time()
    outcomes = {(*key, "ok"): answers.count for key, answers in show.answers.items()} | show.failures
    for (policy, version, protocol, code), count in outcomes.items():
        which = {"policy": policy, "version": version, "protocol": protocol, "code": code}
        show.counter("rlservo_requests", "Requests by outcome", count, **which)
    for policy, count in handler.admission.streams.items():
        show.gauge("rlservo_streams", "Open WebSockets", count, policy=policy)
    for (policy, version, succeeded), count in show.ends.items():
        which = {"policy": policy, "version": version, "outcome": SUCCESS if succeeded else "other"}
        show.counter("rlservo_episode_ends", "Episodes whose end a client reported (`final_status`)", count, **which)
    for ((policy, version, shadow), reason), count in list(handler.shadows.missed.items()):
        which = {"policy": policy, "version": version, "shadow": shadow, "reason": reason}
        show.counter("rlservo_shadow_missed", "Actions not compared with a shadow's", count, **which)


def versions(handler: RequestHandler) -> None:
    """Sample the plan that this process follows, and each version's default flag, batches and drift."""
    show = handler.metrics
    plan, store = handler.control.plan, handler.control.store
    if plan is None or store is None:
        return
    show.gauge("rlservo_plan_generation", "Number of the plan that this process follows", plan.generation)
    missing = "Versions of the plan that this process could not load: it serves older ones, or none"
    show.gauge("rlservo_versions_missing", missing, len(handler.control.behind))
    for policy in store.policies:
        name, version = policy.contract.name, policy.contract.version
        which, is_default = {"policy": name, "version": version}, version == store.default(name)
        show.gauge("rlservo_policy_loaded", "1 for the default version, 0 for the others", is_default, **which)
        drift = policy.drift
        if drift is None:
            continue
        show.counter("rlservo_observation_looks", "Observations checked for drift", drift.looks, **which)
        elements, moved, varied = drift.elements if drift.looks else (), drift.shift, drift.spread
        if len(elements) > MAX_ELEMENTS:
            elements, moved, varied = ("largest",), moved[[np.argmax(np.abs(moved))]], varied[[np.argmax(varied)]]
        for element, mean, deviation in zip(elements, moved.tolist(), varied.tolist()):  # noqa: B905 - none before a look
            shift = "Shift of an observation element's mean from training's, in training's standard deviations"
            show.gauge("rlservo_observation_shift", shift, mean, **which, element=element)
            spread = "Standard deviation of an observation element, relative to training"
            show.gauge("rlservo_observation_spread", spread, deviation, **which, element=element)


def process(handler: RequestHandler) -> None:
    """Sample this process's queue, API keys and recording."""
    admission, keys, show = handler.admission, handler.keys, handler.metrics
    show.gauge("rlservo_uptime_seconds", "Time since this process's start", time.monotonic() - show.began)
    show.gauge("rlservo_start_time_seconds", "Start of this process, since 1970", show.began_at)
    if (lost := show.lost_workers()) is not None:
        show.counter("rlservo_workers_lost", "Workers that died unexpectedly, as counted in each worker", lost)
    waited = "Largest number of requests that waited for the processor at once, since the start"
    show.gauge("rlservo_queue_longest", waited, admission.longest)
    show.gauge("rlservo_requests_incoming", "Requests whose body is still arriving", admission.incoming)
    current = "1 while the API keys in use are those in the key file; 0 if older keys stay in use"
    show.gauge("rlservo_api_keys_current", current, keys.current)
    for label, count in keys.limits.refused.items():
        show.counter("rlservo_rate_limited", "Requests refused because their key exceeded its rate", count, key=label)
    if handler.recorder is not None:
        recorder = handler.recorder.recorder
        goes_on = "1 while decisions are recorded; 0 if the folder cannot be written"
        show.gauge("rlservo_recording", goes_on, recorder.failure is None)
        show.counter("rlservo_records_written", "Decisions and outcomes in the recording", recorder.written)
        show.counter("rlservo_records_dropped", "Decisions dropped by a full recording buffer", recorder.dropped)


def sessions(handler: RequestHandler) -> None:
    """Sample the episodes in memory."""
    episodes, kept, show = handler.episodes, handler.episodes.sessions, handler.metrics
    now, store = kept.count(), handler.control.store
    # From 0 on: a series that begins at 1 shows Prometheus no increase.
    remembering = () if store is None else [each.contract.name for each in store.policies if each.is_stateful]
    for name in sorted({*remembering, *now, *episodes.begun, *episodes.lost}):
        show.gauge("rlservo_sessions", "Sessions in this process", now[name], policy=name)
        show.counter("rlservo_sessions_begun", "Sessions begun", episodes.begun[name], policy=name)
        show.counter("rlservo_sessions_evicted", "Sessions forgotten when idle", kept.evicted[name], policy=name)
        show.counter("rlservo_sessions_lost", "Requests for unknown sessions", episodes.lost[name], policy=name)
    if episodes.store is not None:
        failed = "Failed reads and writes of sessions in Redis; the requests were answered with 503"
        show.counter("rlservo_session_store_failures", failed, episodes.store.unreachable)
    show.gauge("rlservo_episodes_remembered", "Episodes in memory, in sessions and on streams", kept.rows)
