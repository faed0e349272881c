"""The trainer on a cluster that is too small, one that grows, and one that loses a node. All trainings are real."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cluster")


@pytest.fixture(scope="module")
def runs(folder: Path, run_helper: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run_helper("train_on_a_cluster.py", str(folder), folder=folder).splitlines()[-1])
    return found


def test_cluster_that_cannot_hold_the_run_refuses_it(runs: dict[str, Any]) -> None:
    refused = runs["refused"]
    assert refused["code"] == 2
    assert re.search(
        r"error: 3 CPUs asked for \(3 processes with 1 CPU each\); the cluster at [\d.:]+ has 2 CPUs: "
        "give --num-cpus 1",
        refused["said"],
    )
    assert "run: " not in refused["said"]


def test_cluster_that_grows_says_what_it_waits_for(runs: dict[str, Any]) -> None:
    assert runs["grew"]["code"] == 0, runs
    line = "waiting for 3 CPUs (3 processes with 1 CPU each): the cluster has 2 CPUs, 2 of them free; Ctrl-C stops"
    assert runs["grew"]["said"].count(line) >= 1
    assert runs["grew"]["after_s"] >= 9.0
    assert runs["interrupted"]["code"] == 130
    assert "stopped; continue with" in runs["interrupted"]["said"]


def test_training_survives_a_node_killed_on_the_way(runs: dict[str, Any], folder: Path) -> None:
    grew = runs["grew"]
    assert (grew["before"], grew["after"], grew["code"]) == (3, 2, 0), grew
    iterations = [int(n) for n in re.findall(r"^\w+_00000 +(\d+) ", grew["said"], re.MULTILINE)]
    assert iterations[-1] == 5
    assert list(folder.glob("runs/policies/cart-pole/1/contract.json"))
