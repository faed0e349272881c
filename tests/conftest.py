"""Distribution of the tests over pytest-xdist's processes. What they share is in the plugins below."""

from __future__ import annotations

import gc
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

# Where PYTHONDONTWRITEBYTECODE is set, each of this suite's hundreds of processes would compile rlservo's modules
# again, and each of pytest's all test files.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# numpy's linear algebra and torch wait for their threads by spinning, which is most of what they do beside other
# processes: to fit a recording's values took fifteen times the processor time, an update of a network three times.
# Read when they are imported, in children too.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# gRPC's handlers of a fork end some children before their program begins, such as a video's ffmpeg (grpcio 1.85).
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

# Linux shares the cores among sessions: in one, pytest's processes together got as much of them as one server of a
# test's, and the simulated robots in them stood still.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.setsid()

pytest_plugins = [
    "servers",  # which others import, as the next
    "storages",
    "quick_rllib",  # its settings, for the tests that import RLlib
    "browser",
    "checkpoints",
    "arms",
    "ros",
    "bundles",
    "clusters",
    "cockpits",
    "environments",
    "trainings",
]

# Tests that share what is costly to make, by the beginning of their id. All others share their file's own.
TOGETHER = {
    "tests/envs/robot_server/": "ports of server managers",
    "tests/export/graph/test_operators.py": "torch's compiler",  # imports it
    "tests/export/sources/test_leapp.py": "torch's compiler",
    "tests/export/sources/test_leapp_bundles.py": "torch's compiler",
    "tests/export/sources/test_rsl_rl.py": "torch's compiler",
    "tests/system/test_behind_nginx.py": "live server",
    "tests/system/test_prometheus.py": "live server",
    "tests/system/test_serving.py": "live server",
    "tests/system/test_serving_fuzz.py": "live server",
    "tests/system/test_serving_grpc.py": "live server",
    "tests/system/test_serving_sessions.py": "live server",
    "tests/system/test_robo_gym_client.py": "shipped server",
    "tests/system/test_served_policies.py": "shipped server",
    "tests/system/test_both_engines.py": "cluster",
    "tests/system/test_shared_sessions.py": "cluster",
    "tests/system/test_documents_run.py::test_guide_to_online_learning": "one Ray",
    "tests/benchmarks/test_training_benchmark.py": "one Ray",
    "tests/examples/test_edge_environments.py": "one Ray",
    "tests/examples/test_learn_from_recordings.py": "one Ray",
    "tests/examples/test_shipped_policies.py": "one Ray",
    "tests/examples/test_simple_trainer.py::test_ctrl_c": "one Ray",
    "tests/examples/test_simple_trainer.py::test_resumed": "one Ray",
    "tests/examples/test_simple_trainer.py": "sweep",
    "tests/examples/test_slurm.py::test_several_nodes": "several nodes",
    "tests/examples/test_slurm.py": "sweep",
    "tests/examples/test_tour.py": "one Ray",
    "tests/examples/test_training_guides.py": "one Ray",
    "tests/examples/test_training_scripts.py": "one Ray",
}

# Tests in which something moves in real time, by the beginning of their id: `make test` runs them after the others.
REAL_TIME = (
    "tests/deploy/cockpit/test_page.py",
    "tests/deploy/ros2/",
    "tests/robots/",
    "tests/system/test_documents_run.py::test_guide_to_a_real_arm",
    "tests/system/test_documents_run.py::test_guide_to_ros",
)

# The longest files begin first, those that mostly wait next to those that compute: none is left for the end. Of those
# that need the same checkpoints one begins; the others come when they are trained.
# The files with slow tests follow, then the rest.
LONGEST = (
    "live server", "one Ray", "tests/system/test_documents_run.py",
    "ports of server managers", "tests/export/proof/test_exploration.py", "cluster", "shipped server",
    "tests/test_python_versions.py", "tests/serve_app/repository/test_remote_repository.py",
    "tests/system/test_demo.py", "tests/examples/test_on_a_cluster.py",
    "tests/system/test_embedded_server.py", "tests/export/rllib/test_new_stack.py",
    "tests/client/test_bad_line.py", "sweep", "tests/deploy/learning/test_online_learning.py",
    "tests/export/rllib/test_filter_statistics.py", "several nodes", "tests/export/rllib/test_reported.py",
    "tests/system/test_remote_repository.py", "torch's compiler",
    # of `make quick`
    "tests/serve_app/protocols/test_access.py", "tests/recording/test_recorder.py",
    "tests/policy/test_hostile_bundles.py", "tests/serve_app/server/test_current_keys.py",
)  # fmt: skip

for name in {*TOGETHER, *REAL_TIME, *LONGEST} - {*TOGETHER.values()}:
    assert Path(__file__).parents[1].joinpath(name.partition("::")[0]).exists(), (
        f"{name} is in a table, and is not there"
    )

# Servers and Rays that tests share. An unused one still takes a tenth of a core or more.
RUNNING = {"live_server", "shipped_server", "cluster", "one_ray"}


def group_of(nodeid: str) -> str:
    """Return what a test runs together with: its file, or those that share more."""
    shared = (group for beginning, group in TOGETHER.items() if nodeid.startswith(beginning))
    return next(shared, nodeid.partition("::")[0])


class ByGroup(LoadScopeScheduling):
    """All tests of a group in one process."""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no other file where only tests in real time are chosen: the others' imports take each process seconds."""
    place = collection_path.relative_to(Path(__file__).parents[1]).as_posix()
    files = [beginning.partition("::")[0] for beginning in REAL_TIME if config.option.markexpr == "realtime"]
    return None if not files or any(map(place.startswith, files)) or any(f.startswith(place) for f in files) else True


@pytest.hookimpl(optionalhook=True)  # -p no:xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByGroup:
    """Take the place of `--dist`: marks (loadgroup) do not reach xdist 3.8 under pytest 9.2."""
    config.option.loadscopereorder = False  # the order below, not the files with the most tests first
    return ByGroup(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.nodeid.startswith(REAL_TIME):
            item.add_marker("realtime")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    places = {group: place for place, group in enumerate(LONGEST)}
    items.sort(key=lambda item: (places.get(group_of(item.nodeid), len(places)), item.path not in slow))


class SharedFixtures:
    """Ends what a group shares as soon as its last test has run, not with the session."""

    def __init__(self) -> None:
        self._running: list[tuple[pytest.FixtureDef[Any], Any]] = []

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep each group's tests together, in whatever order the others have put them."""
        first: dict[str, int] = {}
        for item in items:
            first.setdefault(group_of(item.nodeid), len(first))
        items.sort(key=lambda item: first[group_of(item.nodeid)])

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any], request: Any) -> Any:
        if fixturedef.argname in RUNNING:
            self._running.append((fixturedef, request))
        return (yield)

    @pytest.hookimpl(trylast=True)  # after the module's own fixtures
    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> None:
        if nextitem is None or group_of(nextitem.nodeid) != group_of(item.nodeid):
            while self._running:
                fixturedef, request = self._running.pop()
                fixturedef.finish(request)


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(SharedFixtures())
    if "PYTEST_XDIST_WORKER" not in os.environ:  # workers inherit it
        # What libraries leave in the folder for temporary files, such as a browser's sockets, ends with the session.
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
        folder = tempfile.mkdtemp(prefix="t")  # the paths of Ray's sockets, in it, may have 107 characters
        os.environ["TMPDIR"] = tempfile.tempdir = folder
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


def pytest_collection_finish() -> None:
    """Leave all that was imported so far out of further collections, of which pytest makes ten in the end."""
    gc.freeze()
