"""Every change of a plan: valid requests and their effects; no files, no server."""

from __future__ import annotations

from typing import Any

import pytest

from rlservo.errors import ConflictError, UnknownPolicyError, UnknownVersionError, UsageError
from rlservo.serve_app.repository.repository import Listing
from rlservo.serve_app.versions.deployment_plan import Plan, PolicyPlan, ServedConfig
from rlservo.serve_app.versions.plan_commands import (
    Load,
    Rollback,
    SetAlias,
    SetCanary,
    Unload,
    agrees,
    first_policies,
)

AVAILABLE = {("ur5", "1"): "a", ("ur5", "2"): "b", ("ur5", "10"): "c", ("mir", "1"): "d"}


def first(config: ServedConfig, available: dict[tuple[str, str], str] = AVAILABLE) -> dict[str, PolicyPlan]:
    return first_policies(config, Listing({key: (digest, "here") for key, digest in available.items()}))


def planned(config: dict[str, Any]) -> dict[str, PolicyPlan]:
    return first(ServedConfig.parse(config))


def alias(plan: Plan, name: str, alias: str, version: str | None) -> dict[str, PolicyPlan]:
    return SetAlias(alias=alias, version=version).change(plan, name)


def rollback(plan: Plan) -> dict[str, PolicyPlan]:
    return Rollback().change(plan, "ur5")


def unload(plan: Plan, name: str, version: str | None) -> dict[str, PolicyPlan]:
    return Unload(version=version).change(plan, name)


def load(plan: Plan, name: str, version: str, digest: str) -> dict[str, PolicyPlan]:
    return Load.of(version, digest).change(plan, name)


def made(policies: dict[str, PolicyPlan], generation: int = 1) -> Plan:
    return Plan(generation=generation, policies=policies, changed_at="now", changed_by="test")


def test_nothing_said_is_everything_there_with_the_newest_by_number_as_default() -> None:
    policies = planned({})
    assert set(policies) == {"ur5", "mir"} and list(policies["ur5"].versions) == ["1", "2", "10"]
    assert policies["ur5"].default == "10"


def test_a_configuration_chooses_versions_and_production_is_the_default() -> None:
    policies = planned(
        {
            "policies": {"ur5": {"versions": [2, "1"], "aliases": {"production": 1, "candidate": "2"},
                                 "canary": {"version": "candidate", "share": 0.25}, "shadow": 2}},
            "unlisted": "ignore",
        }
    )  # fmt: skip
    assert set(policies) == {"ur5"}
    ur5 = policies["ur5"]
    assert (ur5.versions, ur5.default, ur5.shadow) == ({"1": "a", "2": "b"}, "1", "2")
    assert ur5.version_of("candidate") == "2" and ur5.version_of("../..") is None


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ({"policies": {"ur5": {"aliases": {"Production": "1"}}}}, "policies.ur5.aliases"),
        ({"policies": {"ur5": {"versions": ["../1"]}}}, "policies.ur5.versions.0"),
        ({"policies": {"../ur5": {}}}, "policies.../ur5"),
        ({"policies": {"ur5": {"canary": {"version": "1", "share": 1.5}}}}, "share"),
        ({"policies": {"ur5": {"versions": [1.5]}}}, "versions"),
        ({"policy": {}}, "policy: Extra inputs"),
        ([1], "the document"),
    ],
)
def test_a_configuration_that_is_none_is_refused_by_field(config: Any, sentence: str) -> None:
    with pytest.raises(UsageError) as caught:
        ServedConfig.parse(config)
    assert sentence in caught.value.message


@pytest.mark.parametrize(
    ("config", "error", "sentence"),
    [
        ({"policies": {"ur6": {}}}, UnknownPolicyError, "no policy 'ur6': it has mir, ur5"),
        ({"policies": {"ur5": {"versions": ["3"]}}}, UnknownVersionError, "no version 3 .* it has 1, 2, 10"),
        ({"policies": {"ur5": {"versions": [1], "aliases": {"production": 2}}}}, UnknownVersionError, "one of 1"),
        ({"policies": {"ur5": {"shadow": "candidate"}}}, UnknownVersionError, "no alias 'candidate'"),
    ],
)  # fmt: skip
def test_a_configuration_that_leads_nowhere_is_refused(config: Any, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        planned(config)


def test_versions_that_compare_equal_are_refused() -> None:
    with pytest.raises(ConflictError, match=r"'1' and '1\.0\.0'"):
        first(ServedConfig(), {("ur5", "1"): "a", ("ur5", "1.0.0"): "b"})


def test_rollbacks_go_back_through_what_an_alias_was_and_load_what_is_gone() -> None:
    now = made(planned({"policies": {"ur5": {"aliases": {"production": "1"}}}}))
    for version in ("2", "10", "10"):
        now = now.after(alias(now, "ur5", "production", version), "alias")
    assert now.policies["ur5"].history == {"production": ("1", "2")}
    now = now.after(unload(now, "ur5", "2"), "unload")
    assert now.policies["ur5"].unloaded == {"2": "b"}
    now = now.after(rollback(now), "rollback")
    assert now.policies["ur5"].default == "2"
    assert now.policies["ur5"].versions == {"1": "a", "2": "b", "10": "c"}  # the same bundle as before
    now = now.after(rollback(now), "rollback")
    assert now.policies["ur5"].default == "1"
    with pytest.raises(ConflictError, match="has no previous version"):
        rollback(now)


@pytest.mark.parametrize("config", [{}, {"policies": {"ur5": {"versions": ["1", "2"]}}},
                                    {"policies": {"ur5": {"aliases": {"candidate": "1"}}}}])  # fmt: skip
def test_what_is_in_use_at_the_start_is_written_down_and_a_load_never_changes_it(config: dict[str, Any]) -> None:
    now = made(planned(config))
    first = now.policies["ur5"].default
    assert first is not None and now.policies["ur5"].aliases["production"] == first
    now = now.after(load(now, "ur5", "11", "e"), "load")
    assert now.policies["ur5"].default == first
    now = now.after(alias(now, "ur5", "production", "11"), "alias")
    now = now.after(rollback(now), "rollback")
    assert now.policies["ur5"].default == first


def test_production_is_moved_but_neither_removed_nor_unloaded_nor_exchanged() -> None:
    now = made(planned({}))
    with pytest.raises(ConflictError, match="that clients get by default: point it elsewhere, or unload the policy"):
        alias(now, "ur5", "production", None)
    with pytest.raises(ConflictError, match="version 10 is in use by the alias 'production'"):
        unload(now, "ur5", "10")
    with pytest.raises(ConflictError, match=r"version 10 is in use by the alias 'production': .* under a new version"):
        load(now, "ur5", "10", "exchanged")
    assert load(now, "ur5", "10", "c")["ur5"] == now.policies["ur5"]
    assert load(now, "ur5", "2", "exchanged")["ur5"].versions["2"] == "exchanged"  # nothing leads there


def test_a_policy_that_was_not_served_is_in_use_as_what_was_loaded_first() -> None:
    now = made(planned({"policies": {"mir": {}}, "unlisted": "ignore"}))
    now = now.after(load(now, "ur5", "2", "b"), "load")
    assert now.policies["ur5"].default == "2"
    now = now.after(load(now, "ur5", "10", "c"), "load")
    assert now.policies["ur5"].default == "2"


def test_unloading_a_policy_and_loading_another_version_leaves_the_way_back() -> None:
    now = made(planned({"policies": {"ur5": {"versions": ["1", "2"], "aliases": {"production": "1"}}}}))
    now = now.after(alias(now, "ur5", "production", "2"), "alias")
    now = now.after(unload(now, "ur5", None), "unload")
    with pytest.raises(UnknownPolicyError, match=r"no policy 'ur5' is loaded: this server has mir$"):
        now.policy("ur5")
    again = now.after(load(now, "ur5", "2", "b"), "load")
    assert again.policies["ur5"].history == {"production": ("1",)}  # what is in use is not its own way back
    now = now.after(load(now, "ur5", "10", "c"), "load")
    now = now.after(rollback(now), "rollback")
    assert now.policies["ur5"].default == "2" and now.policies["ur5"].versions == {"2": "b", "10": "c"}


def test_what_is_in_use_is_not_unloaded() -> None:
    canary = {"version": "candidate", "share": 0.1}
    ur5 = {"aliases": {"production": "1", "candidate": "2"}, "canary": canary, "shadow": "10"}
    now = made(planned({"policies": {"ur5": ur5}}))
    with pytest.raises(ConflictError, match="alias 'candidate' and the canary"):
        unload(now, "ur5", "2")
    with pytest.raises(ConflictError, match="in use by the shadow"):
        unload(now, "ur5", "10")
    with pytest.raises(ConflictError, match="in use by the canary: end that"):
        alias(now, "ur5", "candidate", None)
    with pytest.raises(ConflictError, match="the last of policy 'mir'"):
        unload(now, "mir", "1")
    with pytest.raises(ConflictError, match="no alias 'old': it has production, candidate"):
        alias(now, "ur5", "old", None)
    assert {name for name, policy in unload(now, "mir", None).items() if policy.versions} == {"ur5"}
    with pytest.raises(UnknownVersionError, match="no version '3'"):
        SetCanary(version="3", share=0.5).change(now, "ur5")


def test_a_plan_agrees_with_its_configuration_until_a_command_changes_what_that_says() -> None:
    config = ServedConfig.parse({"policies": {"ur5": {"versions": ["1", "2"], "aliases": {"production": "1"}}}})
    before = made(first(config))
    assert agrees(before, config)
    after = before.after(alias(before, "ur5", "production", "2"), "alias")
    assert not agrees(after, config)
    assert not agrees(after, ServedConfig.parse({"policies": {"ur5": {"versions": ["3"]}}}))


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({}, True),  # it does not name production: that stays where it is
        ({"policies": {"ur5": {"versions": ["1", "2"], "shadow": "2"}}}, True),
        ({"policies": {"ur5": {"versions": ["2"]}}}, False),
        ({"policies": {"ur5": {"shadow": "1"}}}, False),
        ({"policies": {"ur5": {"aliases": {"candidate": "2"}, "shadow": "2"}}}, False),
        ({"policies": {"mir": {}}, "unlisted": "ignore"}, False),
    ],
)
def test_a_configuration_says_nothing_about_what_it_does_not_name(config: dict[str, Any], expected: bool) -> None:
    ur5 = {"versions": ["1", "2"], "aliases": {"production": "1"}, "shadow": "2" if config else None}
    plan = made(planned({"policies": {"ur5": ur5}, "unlisted": "ignore"}))
    assert agrees(plan, ServedConfig.parse(config)) is expected
