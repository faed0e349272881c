"""Limits of a promotion, and counts read from metrics: decisive figures, and metrics that are not trusted."""

from __future__ import annotations

from typing import Any

import pytest

from rlservo.client.promotion_evidence import (
    ANSWERS,
    DIFFERENCES,
    ENDS,
    LOADED,
    MISSED,
    OUTCOMES,
    PLAN,
    UPTIME,
    Counts,
    Figure,
    PromotionLimits,
    UntrustedError,
    figures,
    interval,
    read_metrics,
)
from rlservo.errors import UnavailableError


def figure(total: dict[str, float], **limit: Any) -> Figure:
    (found,) = figures(PromotionLimits(**limit), total, "1", "2")
    return found


def outcomes(**counts: float) -> dict[str, float]:
    return {f"{OUTCOMES}/2/{code.replace('_', '-')}": count for code, count in counts.items()}


def latency(fast: float, at_the_limit: float, slow: float) -> dict[str, float]:
    counts = {"0.01": fast, "0.02": fast + at_the_limit, "0.05": fast + at_the_limit + slow}
    return {f"{ANSWERS}/2/{bound}": count for bound, count in {**counts, "+Inf": counts["0.05"]}.items()}


def ends(version: str, won: float, lost: float) -> dict[str, float]:
    return {f"{ENDS}/{version}/success": won, f"{ENDS}/{version}/other": lost}


def test_interval_is_that_of_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rlservo.client.promotion_evidence.Z", 1.959964)
    assert interval(0, 10) == (pytest.approx(0.0), pytest.approx(0.2775, abs=1e-4))
    assert interval(81, 263) == (pytest.approx(0.2553, abs=1e-4), pytest.approx(0.3662, abs=1e-4))


def test_a_single_failure_decides_nothing_and_many_decide_at_once() -> None:
    one = figure(outcomes(ok=4, unsafe_action=1), error_rate=0.001)
    assert one.is_beyond and not one.is_surely_beyond and one.lacks.startswith("1,000 needed")
    five = figure(outcomes(ok=4, unsafe_action=3, internal=2), error_rate=0.001)
    assert five.is_surely_beyond and str(five).startswith("failed requests (internal, unsafe-action): 5 of 9, 55.6%")
    noise = figure(outcomes(ok=997, internal=3), error_rate=0.001)
    assert noise.is_beyond and not noise.is_surely_beyond and not noise.lacks  # 0.3%, and 0.1% cannot be excluded
    none = figure(outcomes(ok=5000), error_rate=0.0)
    assert not none.is_beyond and not none.lacks


def test_what_clients_do_wrong_is_not_the_versions() -> None:
    codes = ("bad_request", "unauthenticated", "rate_limited", "session_lost", "unavailable")
    seen = figure(outcomes(ok=2000, **dict.fromkeys(codes, 50.0)), error_rate=0.001)
    assert (seen.against, seen.cases, seen.is_beyond) == (0.0, 2000, False)


@pytest.mark.parametrize("code", ["late", "over-capacity", "deadline-passed"])
def test_requests_of_any_version_that_wait_count_against_the_one_on_trial(code: str) -> None:
    """A slow version keeps those of production waiting."""
    others = {f"{OUTCOMES}/1/ok": 900.0, f"{OUTCOMES}/1/{code}": 30.0, f"{OUTCOMES}/2/{code}": 20.0}
    failed, late = figures(PromotionLimits(error_rate=0.02), outcomes(ok=200) | others, "1", "2")
    assert (failed.against, failed.cases) == (0.0, 200.0)
    assert (late.against, late.cases, late.is_surely_beyond, late.lacks) == (50.0, 1150.0, True, "")
    _, late_as_before = figures(
        PromotionLimits(error_rate=0.02), outcomes(ok=200) | others, "1", "2", (300.0, 10_000.0)
    )
    assert not late_as_before.is_beyond
    assert str(late) == "requests of all versions that waited too long: 50 of 1,150, 4.35% (allowed 2%)"


def test_a_rare_limit_wants_more_requests() -> None:
    assert figure(outcomes(ok=999), error_rate=0.001).lacks and not figure(outcomes(ok=1000), error_rate=0.001).lacks
    assert figure(outcomes(ok=99), error_rate=0.05).lacks and not figure(outcomes(ok=100), error_rate=0.05).lacks


def test_answers_within_the_limit_are_not_slow_and_a_limit_between_bounds_is_the_stricter_one() -> None:
    within = latency(900, 100, 0)
    assert not figure(within, p99_s=0.02).is_beyond
    assert figure(within, p99_s=0.015).is_surely_beyond and "above 10 ms: 100" in str(figure(within, p99_s=0.015))
    assert figure(latency(900, 0, 100), p99_s=0.02).is_surely_beyond
    assert not figure(latency(995, 0, 5), p99_s=0.02).is_beyond
    assert not figure(latency(1, 0, 1), p99_s=0.02).is_surely_beyond
    assert figure(latency(500, 0, 0), p99_s=0.001).is_surely_beyond  # faster than the server can measure
    assert figure({}, p99_s=0.02).lacks


def test_success_drops_by_percentage_points_and_few_episodes_do_not_decide() -> None:
    few = figure(ends("1", 3, 0) | ends("2", 0, 3), success_drop=0.02)
    assert few.is_beyond and not few.is_surely_beyond and few.lacks
    many = figure(ends("1", 98, 2) | ends("2", 50, 50), success_drop=0.02)
    assert many.is_beyond and many.is_surely_beyond and not many.lacks
    assert not figure(ends("1", 96, 4) | ends("2", 95, 5), success_drop=0.02).is_beyond
    assert figure(ends("1", 960, 40) | ends("2", 900, 100), success_drop=0.02).is_beyond
    assert not figure(ends("1", 60, 40) | ends("2", 100, 0), success_drop=0.02).is_beyond
    unknown = figure(ends("2", 0, 40), success_drop=0.02)  # no client reported of production
    assert unknown.lacks and not unknown.is_surely_beyond


def test_actions_that_are_apart_or_could_not_be_computed_count_against_it() -> None:
    def compared(close: float, apart: float, failed: float = 0.0) -> dict[str, float]:
        counts = {f"{DIFFERENCES}/1/2/{bound}": close for bound in ("0.05", "0.1")}
        return counts | {f"{DIFFERENCES}/1/2/+Inf": close + apart, f"{MISSED}/1/2/failed": failed}

    assert not figure(compared(300, 0), action_difference=0.05).is_beyond
    assert not figure(compared(998, 2), action_difference=0.05).is_beyond
    assert figure(compared(280, 20), action_difference=0.05).is_surely_beyond
    assert figure(compared(280, 0, failed=60), action_difference=0.05).is_surely_beyond
    left_out = figure({f"{MISSED}/1/2/left-out": 400.0}, action_difference=0.05)
    assert left_out.lacks and left_out.cases == 0


def counted(uptime: float, **replicas: float) -> dict[str, dict[str, float]]:
    return {
        name: {"a": count, PLAN: 10 - count, UPTIME: uptime, f"{LOADED}/2": 0.0} for name, count in replicas.items()
    }


def test_counts_are_increments_over_processes_that_come_and_go() -> None:
    counts = Counts({}, {})
    looks = ({"a": 100, "b": 50}, {"a": 110, "b": 60}, {"a": 112}, {"a": 112, "c": 7}, {"b": 61, "c": 9})
    for uptime, look in enumerate(looks):
        counts.add(counted(uptime, **look))
    assert counts.total["a"] == 10 + 10 + 2 + 1 + 2  # b was out of sight; c counts from its first look
    with pytest.raises(UntrustedError, match="a of replica 'b' fell by 11: was its server restarted"):
        counts.add(counted(5, b=50))


def test_a_copy_is_not_counted_and_nothing_is_counted_twice_after_it() -> None:
    counts = Counts({}, {})
    counts.add(counted(1, a=100))
    for count in (100, 107):  # some of a worker's counts are newer than its uptime
        with pytest.raises(UnavailableError, match="'a' are still those of the last check"):
            counts.add(counted(1, a=count))
    counts.add(counted(2, a=110))
    assert counts.total["a"] == 10


TEXT = """# TYPE rlservo_plan_generation gauge
rlservo_plan_generation{replica="r"} 7.0
rlservo_policy_loaded{policy="ur5",replica="r",version="2"} 0.0
rlservo_requests_total{code="ok",policy="ur5",protocol="json",replica="r",version="2"} 3.0
rlservo_requests_total{code="ok",policy="ur5",protocol="oip",replica="r",version="2"} 4.0
rlservo_request_seconds_bucket{le="0.01",policy="ur5",protocol="json",replica="r",version="2"} 7.0
rlservo_request_seconds_bucket{le="+Inf",policy="ur5",protocol="json",replica="r",version="2"} 8.0
rlservo_requests_total{code="ok",policy="other",protocol="json",replica="r",version="2"} 99.0
"""


def test_metrics_are_summed_over_protocols_for_each_process() -> None:
    other = "\n".join(line for line in TEXT.replace('"ur5"', '"other"').splitlines() if PLAN not in line)
    (process,) = read_metrics(TEXT + other + "\n", "ur5").values()
    counts = {f"{OUTCOMES}/2/ok": 7, f"{ANSWERS}/2/0.01": 7, f"{ANSWERS}/2/+Inf": 8}
    assert process == {PLAN: 7, f"{LOADED}/2": 0, **counts}
    with pytest.raises(UnavailableError, match="have no series for policy 'ur5'"):
        read_metrics("python_info 1.0\n", "ur5")


@pytest.mark.parametrize(
    ("true", "false"),
    [
        ('"oip",replica="r",version="2"} 4.0', '"oip",replica="r",version="2"} 40.0'),
        ('version="2"} 7.0', 'version="2"} 9.0'),
        ('version="2"} 7.0', 'version="2"} -1.0'),
        (',version="2"} 3.0', "} 3.0"),
        ("} 3.0", "} NaN"),
        ("} 7.0\nrlservo_policy", "} NaN\nrlservo_policy"),
        ("} 3.0", "} +Inf"),
        ("} 3.0", "} three"),
        ('le="0.01"', 'le="abc"'),
        ('le="0.01"', 'le="NaN"'),
        (',protocol="json"', ',="json"'),
        (TEXT, TEXT + TEXT),
    ],
)
def test_metrics_that_contradict_themselves_are_not_trusted(true: str, false: str) -> None:
    assert true in TEXT
    with pytest.raises(UntrustedError):
        read_metrics(TEXT.replace(true, false), "ur5")
