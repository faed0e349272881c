"""The folder that `rlservo page` writes, and what it refuses. No browser, no network."""

from __future__ import annotations

import functools
import http.server
import json
import runpy
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bundles import write_box_policy, write_leaky_policy
from command_line import rlservo
from rlservo.bundle import bundle as bundle_files
from rlservo.deploy.page import npm_packages, static_site
from rlservo.errors import RlservoError, UsageError
from rlservo.export.card import card


@pytest.fixture
def write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, int]]:
    """Write a site without libraries."""
    monkeypatch.setattr(static_site, "libraries", lambda say: {})

    def run(*bundles: Path, out: Path = tmp_path / "site") -> dict[str, int]:
        return static_site.write_site(bundles, out, lambda line: None)

    return run


def test_a_page_replaces_an_earlier_page_and_nothing_else(write: Callable[..., dict[str, int]], tmp_path: Path) -> None:
    site = tmp_path / "site"
    write(write_box_policy(tmp_path, name="first"))
    write(write_box_policy(tmp_path, name="second"))
    assert [path.name for path in (site / "policies").iterdir()] == ["second"]
    (site / "mine.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"site holds mine\.txt, which is not part of a page that rlservo wrote"):
        write(write_box_policy(tmp_path, name="third"))
    assert (site / "mine.txt").read_text() == "mine"
    assert (site / "policies" / "second" / "policy.onnx").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "second", "site", "third"]


def test_folders_and_files_of_others_are_kept(write: Callable[..., dict[str, int]], tmp_path: Path) -> None:
    bundle = write_box_policy(tmp_path)
    for name, content in (("policies.json", "[]"), ("index.html", "mine")):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text(content)
        with pytest.raises(UsageError, match="name another folder"):
            write(bundle, out=tmp_path / name)
        with pytest.raises(UsageError, match="name another folder"):
            write(bundle, out=tmp_path / name / name)
        assert (tmp_path / name / name).read_text() == content


def test_a_page_larger_than_a_phone_loads_is_refused(
    write: Callable[..., dict[str, int]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    bundle = write_box_policy(tmp_path)
    whole = sum(write(bundle).values())
    for limit, size in ((whole - 1, whole), (100_000, (bundle / "policy.onnx").stat().st_size)):
        monkeypatch.setattr(static_site, "MAX_BYTES", limit)
        with pytest.raises(UsageError, match=f"would have {size / 1e6:.1f} MB: at most"):
            write(bundle, out=tmp_path / "other")
        assert not (tmp_path / "other").exists()


def test_two_bundles_of_one_name_are_refused(write: Callable[..., dict[str, int]], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="two of the bundles are called 'ur5'"):
        write(write_box_policy(tmp_path), write_box_policy(tmp_path, version="2"))


def test_the_manifest_lists_every_file(write: Callable[..., dict[str, int]], tmp_path: Path) -> None:
    sizes = write(write_box_policy(tmp_path, name="a"), write_box_policy(tmp_path, name="b", version="7"))
    site = tmp_path / "site"
    there = {str(path.relative_to(site)): path.stat().st_size for path in site.rglob("*") if path.is_file()}
    listed = json.loads((site / "policies.json").read_text())
    assert there == sizes
    assert sorted(there) == listed["files"]
    assert listed["policies"] == [{"name": "a", "version": "1"}, {"name": "b", "version": "7"}]


def test_a_bundle_without_golden_values_is_refused(write: Callable[..., dict[str, int]], tmp_path: Path) -> None:
    from rlservo.bundle import bundle as bundle_files

    folder = write_box_policy(tmp_path)
    bundle_files.write_golden(folder, {}, {})
    bundle_files.write_contract(folder, bundle_files.read_contract(folder))
    with pytest.raises(RlservoError, match=r"golden\.npz holds no samples of"):
        write(folder)
    assert not (tmp_path / "site").exists()


# -- npm's registry


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A registry on this machine; its folder. The user's cache is empty."""
    folder = tmp_path / "registry"
    folder.mkdir()

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("npm_config_registry", f"http://127.0.0.1:{server.server_port}/")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield folder
    server.shutdown()
    server.server_close()


def test_a_package_that_is_not_the_pinned_one_is_refused_and_not_kept(registry: Path, tmp_path: Path) -> None:
    file = registry / "onnxruntime-web" / "-" / "onnxruntime-web-1.30.0.tgz"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"another")
    with pytest.raises(RlservoError, match=r"is not the onnxruntime-web 1\.30\.0 that was pinned: its sha512 differs"):
        npm_packages.libraries(lambda line: None)
    assert not (tmp_path / "cache").exists()


def test_a_package_without_an_end_is_not_read_to_it(registry: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = registry / "onnxruntime-web" / "-" / "onnxruntime-web-1.30.0.tgz"
    file.parent.mkdir(parents=True)
    file.write_bytes(bytes(20 * npm_packages.BLOCK))
    monkeypatch.setattr(npm_packages, "MOST_BYTES", 2 * npm_packages.BLOCK)
    said: list[str] = []
    with pytest.raises(RlservoError, match="its sha512 differs"):
        npm_packages.libraries(said.append)
    assert len([line for line in said if "MB" in line]) == 3


def test_a_package_that_cannot_be_fetched_is_named_with_what_to_do(registry: Path, tmp_path: Path) -> None:
    done = rlservo("page", write_box_policy(tmp_path).parent, "--out", tmp_path / "site")
    assert done.returncode == 1
    sentence = done.stderr.splitlines()[-1]
    assert "onnxruntime-web 1.30.0 cannot be fetched from http://127.0.0.1" in sentence
    assert f"copy {tmp_path / 'cache' / 'rlservo' / 'npm'}" in sentence
    assert not (tmp_path / "site").exists()


def test_a_damaged_copy_in_the_cache_is_fetched_again(registry: Path, tmp_path: Path) -> None:
    kept = tmp_path / "cache" / "rlservo" / "npm" / "onnxruntime-web-1.30.0.tgz"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"half of it")
    said: list[str] = []
    with pytest.raises(RlservoError, match="cannot be fetched"):  # the registry is empty
        npm_packages.libraries(said.append)
    assert said == [f"fetching onnxruntime-web 1.30.0 from {registry_address(said)}, once, into {kept.parent}"]


def registry_address(said: list[str]) -> str:
    return said[0].split(" from ")[1].split(", once")[0]


def test_a_policy_of_another_rate_than_its_simulator_is_refused(
    write: Callable[..., dict[str, int]],
    all_shipped: Path,
    tmp_path: Path,
) -> None:
    shipped = bundle_files.read_contract(all_shipped / "mir100_navigation" / "1")
    folder = write_leaky_policy(tmp_path, like=shipped)
    contract = bundle_files.read_contract(folder)
    bundle_files.write_contract(folder, contract.model_copy(update={"control_rate_hz": 15.0}))
    with pytest.raises(UsageError, match=r"acts at 15 Hz, but .*NoObstacleNavigationMir100Sim-v0 at 10 Hz"):
        write(folder)
    assert not (tmp_path / "site").exists()


def test_pages_of_shipped_policies_show_what_was_measured(all_shipped: Path) -> None:
    demo_pages = runpy.run_path(str(Path(__file__).parents[3] / ".ci" / "demo_pages.py"))
    for name in demo_pages["SHOWN"]:
        contract = bundle_files.read_contract(all_shipped / name / "1")
        rows = demo_pages["measured"](name, contract)
        text = card(contract.model_copy(update={"evaluations": rows}))
        assert "Not measured" not in text
        if name == "ur5_positioning":  # as its own README.md says
            assert "from the start pose | 500 | 99.6% | 98.6% to 99.9% |" in text
