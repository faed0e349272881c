"""Summary of a recording: policies, episodes, times and missing records."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from rlservo.recording.episodes import episodes
from rlservo.recording.reader import Recording

MOST_LATENCIES = 1_000_000


@dataclass
class RecordedPolicySummary:
    """One recorded policy."""

    name: str
    version: str
    graph_sha256: str
    contract_sha256: str
    options: dict[str, Any]
    episodes: int = 0
    ended: int = 0
    decisions: int = 0
    without_action: int = 0
    fallbacks: int = 0
    explored: int = 0
    warnings: int = 0
    gaps: int = 0
    """Episodes in which decisions are missing."""
    return_mean: float | None = None
    """Over the finished episodes whose rewards are all known."""
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    seconds: float = 0.0
    """Duration of its episodes; at the control rate where a simulation ran at full speed."""
    first_s: float = float("inf")
    last_s: float = 0.0
    endings: dict[str, int] = field(default_factory=dict)


@dataclass
class Summary:
    """Content of a recording."""

    files: list[dict[str, Any]]
    policies: list[RecordedPolicySummary]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


def summarise_recording(recording: Recording) -> Summary:
    """Read a recording once and return its summary. Raises RecordingError."""
    found: dict[int, RecordedPolicySummary] = {}
    returns: dict[int, list[float]] = {}
    latencies: dict[int, list[float]] = {}
    endings: dict[int, Counter[str]] = {}
    for episode in episodes(recording):
        policy, key = episode.policy, id(episode.policy)
        if key not in found:
            found[key] = RecordedPolicySummary(
                policy.contract.name,
                policy.contract.version,
                policy.graph_hash,
                policy.contract_hash,
                policy.options,
            )
        summary = found[key]
        summary.episodes += int(episode.begins and bool(episode.id))
        summary.ended += int(episode.ended)
        summary.decisions += len(episode)
        summary.without_action += int((~episode.acted).sum())
        summary.fallbacks += int(episode.fell_back.sum())
        summary.explored += int(episode.explored.sum())
        summary.warnings += len(episode.warnings)
        summary.gaps += int(bool(episode.id) and episode.gap is not None)
        summary.seconds += float(episode.episode_s[-1]) if episode.id else 0.0
        summary.first_s = min(summary.first_s, float(episode.time_s.min()))
        summary.last_s = max(summary.last_s, float(episode.time_s.max()))
        if episode.ended and episode.begins and np.isfinite(episode.reward).all():
            returns.setdefault(key, []).append(float(episode.reward.sum()))
        if episode.ended:
            word = episode.final_status or ("terminated" if episode.terminated else "truncated")
            endings.setdefault(key, Counter())[word] += 1
        known = latencies.setdefault(key, [])
        if len(known) < MOST_LATENCIES:
            known += episode.latency_ms[np.isfinite(episode.latency_ms)].tolist()
    for key, summary in found.items():
        if returns.get(key):
            summary.return_mean = float(np.mean(returns[key]))
        if latencies.get(key):
            summary.latency_p50_ms, summary.latency_p99_ms = (float(p) for p in np.percentile(latencies[key], (50, 99)))
        summary.endings = dict(endings.get(key, Counter()).most_common())
    files = [{**asdict(facts), "path": str(facts.path)} for facts in recording.files]
    return Summary(files, list(found.values()))
