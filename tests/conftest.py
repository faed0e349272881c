"""How the tests are spread over pytest-xdist's processes. What they share is in the plugins below."""

from __future__ import annotations

from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

pytest_plugins = ["checkpoints", "bundles", "environments", "servers"]

# Files whose tests share what is costly to make, by the name of it. The tests of any other file share that file's own.
TOGETHER = {
    "tests/system/test_serving_fuzz.py": "live server",
    "tests/system/test_serving_grpc.py": "live server",
    "tests/examples/test_shipped_policies.py": "one Ray",
    "tests/examples/test_tour.py": "one Ray",
    "tests/examples/test_training_scripts.py": "one Ray",
}


class ByFile(LoadScopeScheduling):
    """All tests of a file in one process, or of the files that are together."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return TOGETHER.get(file, file)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByFile:
    """Take the place of `--dist`: marks (loadgroup) do not reach xdist 3.8 under pytest 9.2."""
    config.option.loadscopereorder = False  # the order below, not the files with the most tests first
    return ByFile(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files with slow tests first: none of them is the last that the others wait for."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
