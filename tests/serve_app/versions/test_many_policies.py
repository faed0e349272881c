"""A repository of many policies: the cost of loading one does not grow with their number."""

from __future__ import annotations

from pathlib import Path

import pytest

from bundles import write_discrete_policy
from rlservo.bundle.bundle import read_contract
from rlservo.serve_app.repository import repository
from stores import load_store


def test_each_contract_is_read_by_one_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 12
    for number in range(count):
        write_discrete_policy(tmp_path, name=f"grid-{number}")
    reads = 0

    def counted(*given: object) -> object:
        nonlocal reads
        reads += 1
        return read_contract(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(repository, "read_contract", counted)
    store = load_store(tmp_path)
    assert len(store.names) == count and reads == count
    store.close()


def test_bundle_that_has_moved_since_the_look_is_found(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    write_discrete_policy(here, name="grid")
    write_discrete_policy(there, name="other")
    places = repository.Repository([here, there])
    digest = places.look().available(needs_all=True)["grid"]["1"]
    (here / "grid").rename(there / "grid")
    with places.fetch("grid", "1", digest) as folder:
        assert folder == there / "grid" / "1"
