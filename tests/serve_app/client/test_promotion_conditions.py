"""Conditions of a promotion: what is understood, and when figures decide."""

from __future__ import annotations

import math
from typing import Any

import pytest

from rlservo.export.contract.errors import UsageError
from rlservo.serve_app.client.promotion_conditions import (
    Comparison,
    Evidence,
    Figure,
    Tally,
    check_limits,
    judge,
    newcombe,
    parse_conditions,
    quantile,
    wilson,
)

BOUNDS = (0.001, 0.01, 0.02, 0.05, 1.0)
DIFFERENCES = (0.01, 0.05, 0.1, 10.0)


def evidence(**given: Any) -> Evidence:
    empty = [0.0] * (len(BOUNDS) + 1)
    candidate = Tally(given.get("latency", empty), given.get("failed", {}), given.get("ends", (0, 0)))
    production = Tally(empty, {}, given.get("ends_before", (0, 0)))
    comparison = given.get("comparison") or Comparison([0.0] * (len(DIFFERENCES) + 1))
    return Evidence(candidate, production, comparison, BOUNDS, DIFFERENCES)


def figure(text: str, **given: Any) -> Figure:
    (condition,) = parse_conditions(text)
    return judge(condition, evidence(**given), min_requests=100, min_episodes=20)


def test_the_language_is_a_name_a_limit_and_its_unit_joined_by_or() -> None:
    found = parse_conditions("error_rate>0.1% or latency_p99 >= 20ms OR action_difference>0.05 or success_drop > 2%")
    assert [(each.name, each.quantile, each.limit, each.is_inclusive) for each in found] == [
        ("error_rate", None, pytest.approx(0.001), False),
        ("latency", 0.99, pytest.approx(0.02), True),
        ("action_difference", None, 0.05, False),
        ("success_drop", None, pytest.approx(0.02), False),
    ]
    (finer,) = parse_conditions("action_difference_p999>1e-3")
    assert (finer.quantile, finer.limit) == (0.999, 0.001)
    assert parse_conditions("latency_p50>500us")[0].limit == pytest.approx(5e-4)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is no condition"),
        ("error_rate>0.1% or", "is no condition"),
        ("error_rate>0.1% and latency_p99>20ms", "is no condition"),
        ("errors>0.1%", "no quantity is called 'errors': known are error_rate"),
        ("latency>20ms", "expected which share of the requests, such as latency_p99"),
        ("error_rate_p99>1%", "expected error_rate alone"),
        ("error_rate<1%", "with '>' or '>='"),
        ("error_rate>0.1", "expected % after the number"),
        ("latency_p99>20", "expected ms or us or s after"),
        ("latency_p99>20m", "expected ms or us or s after"),
        ("action_difference>5%", "no unit: it is in the action's own"),
        ("latency_p0>1ms", "expected a share such as p50"),
        ("success_drop>100%", "nothing is above 100%"),
        ("error_rate>-1%", "is no condition"),
        ("error_rate>nan%", "is no condition"),
    ],
)
def test_what_is_not_understood_is_refused_with_what_is_known(text: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_conditions(text)
    assert says in caught.value.message


def test_a_limit_beyond_the_servers_histograms_is_refused() -> None:
    with pytest.raises(UsageError, match="tells values apart up to 1 s"):
        check_limits(parse_conditions("latency_p99>2s"), evidence())
    with pytest.raises(UsageError, match="up to 10"):
        check_limits(parse_conditions("action_difference_p99>11"), evidence())
    check_limits(parse_conditions("latency_p99>1s or error_rate>1% or action_difference>11"), evidence())


def test_intervals_are_those_of_the_papers() -> None:
    assert wilson(0, 10, 1.959964) == (pytest.approx(0.0), pytest.approx(0.2775, abs=1e-4))
    assert wilson(81, 263, 1.959964) == (pytest.approx(0.2553, abs=1e-4), pytest.approx(0.3662, abs=1e-4))
    # Newcombe 1998, table II, contrast (a), method 10.
    assert newcombe(56, 70, 48, 80, 1.959964) == (
        pytest.approx(0.2), pytest.approx(0.0524, abs=1e-4), pytest.approx(0.3339, abs=1e-4),
    )  # fmt: skip


def test_of_no_failures_the_interval_begins_at_zero() -> None:
    assert "99.7% interval 0% to" in figure("error_rate>1%", latency=[766, 0, 0, 0, 0, 0]).sentence()


def test_a_single_failure_decides_nothing_and_many_decide_at_once() -> None:
    one = figure("error_rate>0.1%", latency=[4, 0, 0, 0, 0, 0], failed={"unsafe-action": 1})
    assert one.is_beyond and not one.is_certain and not one.is_enough
    five = figure("error_rate>0.1%", latency=[4, 0, 0, 0, 0, 0], failed={"unsafe-action": 3, "internal": 2})
    assert five.is_certain and "5 of 9 requests failed by internal 2, unsafe-action 3" in five.sentence()
    noise = figure("error_rate>0.1%", latency=[997, 0, 0, 0, 0, 0], failed={"internal": 3})
    assert noise.is_beyond and not noise.is_certain and noise.is_enough  # 0.3%, and 0.1% cannot be excluded


def test_what_clients_do_wrong_and_what_the_server_turns_away_is_not_the_versions() -> None:
    codes = ("bad-request", "unauthenticated", "rate-limited", "late", "over-capacity", "deadline-passed")
    seen = figure("error_rate>0.1%", latency=[2000, 0, 0, 0, 0, 0], failed=dict.fromkeys(codes, 50.0))
    assert (seen.value, seen.count, seen.is_beyond) == (0.0, 2000, False)


def test_a_rare_limit_wants_more_requests() -> None:
    assert figure("error_rate>0.1%").needed == 1000 and figure("error_rate>5%").needed == 100
    assert figure("latency_p999>20ms").needed == 1000 and figure("latency_p99>20ms").needed == 100


def test_latency_is_certain_only_by_what_is_surely_above_the_limit() -> None:
    fast = figure("latency_p99>20ms", latency=[0, 1000, 0, 0, 0, 0])
    assert fast.value == pytest.approx(0.01, rel=0.02) and not fast.is_beyond
    within = figure("latency_p99>30ms", latency=[0, 0, 0, 1000, 0, 0])  # all in the bucket that holds 30 ms
    assert within.is_beyond and not within.is_certain
    slow = figure("latency_p99>20ms", latency=[0, 900, 0, 100, 0, 0])
    assert slow.is_beyond and slow.is_certain and "100 of them surely above" in slow.sentence()
    assert not figure("latency_p99>20ms", latency=[0, 1, 0, 1, 0, 0]).is_certain
    assert "more than the server tells apart" in figure("latency_p99>20ms", latency=[0, 0, 0, 0, 0, 500]).sentence()


def test_quantiles_are_as_prometheus_has_them() -> None:
    assert quantile([0, 10, 0, 0, 0, 0], BOUNDS, 0.5) == pytest.approx(0.0055)
    assert quantile([5, 5, 0, 0, 0, 0], BOUNDS, 0.5) == pytest.approx(0.001)
    assert math.isinf(quantile([0, 0, 0, 0, 0, 3], BOUNDS, 0.5))


def test_success_drops_by_percentage_points_and_few_episodes_do_not_decide() -> None:
    few = figure("success_drop>2%", ends=(0, 3), ends_before=(3, 0))
    assert few.is_beyond and not few.is_certain and not few.is_enough
    many = figure("success_drop>2%", ends=(50, 50), ends_before=(98, 2))
    assert many.value == pytest.approx(0.48) and many.is_certain and many.is_enough
    equal = figure("success_drop>2%", ends=(95, 5), ends_before=(96, 4))
    assert not equal.is_beyond and not equal.is_certain
    better = figure("success_drop>2%", ends=(100, 0), ends_before=(60, 40))
    assert better.value == pytest.approx(-0.4) and not better.is_beyond
    assert not figure("success_drop>2%", ends=(40, 0)).is_enough  # nobody told of production


def test_actions_differ_in_the_mean_or_in_a_share_of_them() -> None:
    close = Comparison([300, 0, 0, 0, 0], total=300 * 0.004, squares=300 * 0.004**2)
    assert not figure("action_difference>0.05", comparison=close).is_beyond
    far = Comparison([0, 0, 0, 300, 0], total=300 * 0.4, squares=300 * 0.4**2)
    assert figure("action_difference>0.05", comparison=far).is_certain
    tail = Comparison([280, 0, 0, 20, 0], total=20 * 0.2, squares=20 * 0.2**2)
    assert not figure("action_difference>0.05", comparison=tail).is_beyond
    assert figure("action_difference_p95>0.05", comparison=tail).is_beyond
    broken = Comparison([280, 0, 0, 0, 0], failed=60)
    for text in ("action_difference>0.05", "action_difference_p95>0.05"):
        assert figure(text, comparison=broken).is_certain
    nothing = figure("action_difference>0.05", comparison=Comparison([0] * 5, left_out=400))
    assert not nothing.is_enough and "0 actions compared, 400 left out" in nothing.sentence()
