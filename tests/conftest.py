"""How the tests are spread over pytest-xdist's processes. What they share is in the plugins below."""

from __future__ import annotations

from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

pytest_plugins = ["checkpoints", "bundles", "clusters", "cockpits", "environments", "servers"]

# Tests that share what is costly to make, by the beginning of their id. All others share their file's own.
TOGETHER = {
    "tests/envs/robot_server/": "ports of server managers",
    "tests/system/test_serving.py": "live server",
    "tests/system/test_serving_fuzz.py": "live server",
    "tests/system/test_serving_grpc.py": "live server",
    "tests/system/test_serving_network.py": "live server",
    "tests/system/test_serving_protocols.py": "live server",
    "tests/system/test_serving_sessions.py": "live server",
    "tests/serve_app/protocols/test_access.py::test_on_ray_serve": "live server",
    "tests/serve_app/protocols/test_web_pages.py::test_on_ray_serve": "live server",
    "tests/system/test_robo_gym_client.py": "shipped server",
    "tests/system/test_served_policies.py": "shipped server",
    "tests/system/test_cluster_check.py": "cluster",
    "tests/system/test_policies_under_load.py": "cluster",
    "tests/examples/test_shipped_policies.py": "one Ray",
    "tests/examples/test_tour.py": "one Ray",
    "tests/examples/test_training_scripts.py": "one Ray",
}


class ByFile(LoadScopeScheduling):
    """All tests of a file in one process, or those that are together."""

    def _split_scope(self, nodeid: str) -> str:
        shared = (group for beginning, group in TOGETHER.items() if nodeid.startswith(beginning))
        return next(shared, nodeid.partition("::")[0])


@pytest.hookimpl(optionalhook=True)  # -p no:xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByFile:
    """Take the place of `--dist`: marks (loadgroup) do not reach xdist 3.8 under pytest 9.2."""
    config.option.loadscopereorder = False  # the order below, not the files with the most tests first
    return ByFile(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files with slow tests first: none of them is the last that the others wait for."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
