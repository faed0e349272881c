"""Administration over HTTP and by `rlservo policy`, canary and shadow: real bundles, uvicorn, no Ray."""

from __future__ import annotations

import asyncio
import hashlib
import http.client
import json
import shutil
import stat
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bundles import write_box_policy
from rlservo.client.admin_client import AdminClient, find_key
from rlservo.client.formats.admin_key_file import key_file, read_key, written_key
from rlservo.deploy.cli import app as command_line
from rlservo.deploy.commands.serve import served_config
from rlservo.errors import (
    ConflictError,
    ForbiddenError,
    RefusedError,
    RequestError,
    UnauthenticatedError,
    UnknownVersionError,
    UsageError,
)
from rlservo.policy.policy import Policy
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.server.api_keys import new_key
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.versions.deployment_plan import ServedConfig
from rlservo.serve_app.versions.plan_commands import parse
from rlservo.serve_app.versions.plan_follower import PlanFollower
from rlservo.serve_app.versions.version_loader import VersionLoader
from servers import exchange, over_uvicorn
from stores import plan_files

OBS = [round(0.01 * i, 2) for i in range(27)]


@pytest.fixture(scope="module")
def folder(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ur5 in 1, 2, 10 and a broken 11, a contract that is none under 13; gridworld in 1, twice."""
    root = Path(shutil.copytree(policies, tmp_path_factory.mktemp("admin") / "policies"))
    write_box_policy(root, version="11", seed=4)
    (root / "ur5" / "11" / "golden.npz").unlink()
    shutil.copytree(root / "gridworld" / "1", root / "gridworld" / "2")
    (root / "ur5" / "13").mkdir()
    (root / "ur5" / "13" / "contract.json").write_text("{}")
    return root


@pytest.fixture(scope="module")
def key_path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    file = tmp_path_factory.mktemp("key") / "sub" / "admin.key"
    with written_key(file, new_key("operator", admin=True)[0]):
        yield file


@pytest.fixture
def port(folder: Path, key_path: Path, tmp_path: Path) -> Iterator[int]:
    """A server on which only the operator needs a key; ur5 in 1 and 2, production 1."""
    digest = "sha256:" + hashlib.sha256(read_key(key_path).encode()).hexdigest()
    control = PlanFollower(VersionLoader(Repository([folder])), plan_files(tmp_path))
    config = {"policies": {"ur5": {"versions": ["1", "2"], "aliases": {"production": "1"}},
                           "gridworld": {"versions": ["1"]}}, "unlisted": "ignore"}  # fmt: skip
    asyncio.run(control.configure(config))
    with over_uvicorn(create_app(control, ServerSettings(operator_key=digest), replica="only")) as port:
        yield port


@pytest.fixture
def admin(port: int, key_path: Path) -> Iterator[AdminClient]:
    with AdminClient(f"http://127.0.0.1:{port}", api_key=read_key(key_path)) as client:
        yield client


def ask(port: int, method: str, path: str, document: Any = None, **headers: str) -> tuple[int, Any]:
    reply = exchange(port, method, path, document, **headers)
    return reply.status, reply.document if reply.content[:1] in (b"{", b"[") else reply.content.decode()


def act(port: int, where: str = "act", **fields: Any) -> dict[str, Any]:
    status, reply = ask(port, "POST", f"/v1/policies/ur5/{where}", {"obs": OBS, **fields})
    assert status == 200, reply
    return dict(reply)


def listed(port: int, name: str = "ur5") -> dict[str, Any]:
    _, reply = ask(port, "GET", "/v1/policies")
    return dict(next(policy for policy in reply["policies"] if policy["name"] == name))


def test_a_version_is_asked_for_by_number_or_by_alias_over_every_http_protocol(port: int, admin: AdminClient) -> None:
    admin.alias("ur5", "candidate", "2")
    assert act(port)["version"] == "1"
    assert act(port, "versions/candidate/act")["version"] == act(port, "versions/2/act")["version"] == "2"
    assert ask(port, "GET", "/v1/policies/ur5/versions/candidate")[1]["version"] == "2"
    tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}
    _, reply = ask(port, "POST", "/v2/models/ur5/versions/candidate/infer", {"inputs": [tensor]})
    assert reply["model_version"] == "2"
    assert ask(port, "GET", "/v2/models/ur5/versions/candidate/ready")[0] == 200
    status, reply = ask(port, "POST", "/v1/policies/ur5/versions/old/act", {"obs": OBS})
    assert status == 404 and "expected one of 1, 2; aliases: candidate, production" in reply["error"]
    admin.alias("ur5", "candidate", None)
    assert ask(port, "POST", "/v1/policies/ur5/versions/candidate/act", {"obs": OBS})[0] == 404


def test_the_listing_says_what_runs_since_when_and_how_much(port: int, admin: AdminClient) -> None:
    for _ in range(3):
        act(port)
    admin.alias("ur5", "production", "2")
    policy = listed(port)
    assert (policy["version"], policy["versions"]) == ("2", ["1", "2"])
    assert (policy["aliases"], policy["previous"]) == ({"production": "2"}, {"production": "1"})
    one, two = policy["version_states"]
    assert (one["state"], one["requests"], one["aliases"]) == ("ready", 3, [])
    assert (two["state"], two["requests"], two["aliases"]) == ("ready", 0, ["production"])
    assert one["loaded_at"].startswith("20") and one["loaded_at"].endswith("+00:00")
    _, whole = ask(port, "GET", "/v1/policies")
    assert (whole["replica"], whole["generation"], whole["changed_by"]) == ("only", 2, "alias ur5 production=2")
    recent = [(each["generation"], each["changed_by"]) for each in whole["recent"]]
    assert recent == [(2, "alias ur5 production=2"), (1, "configuration")]
    assert admin.listing() == whole


def test_a_refused_version_is_told_in_the_listing_and_the_index(port: int, admin: AdminClient) -> None:
    with pytest.raises(RefusedError, match=r"nothing has changed: .*golden.npz is missing"):
        admin.load("ur5", "11")
    states = {version["version"]: version for version in listed(port)["version_states"]}
    assert states["11"]["state"] == "failed" and "golden.npz is missing" in states["11"]["reason"]
    index = {(m["name"], m["version"]): m for m in ask(port, "POST", "/v2/repository/index", {})[1]}
    assert index["ur5", "11"]["state"] == "UNAVAILABLE" and index["ur5", "2"]["state"] == "READY"
    ready = ask(port, "POST", "/v2/repository/index", {"ready": True})[1]
    assert ("ur5", "11") not in {(m["name"], m["version"]) for m in ready} and len(ready) == 3


def test_triton_load_and_unload_are_the_same_commands(port: int, key_path: Path) -> None:
    key = {"authorization": f"Bearer {read_key(key_path)}"}
    assert ask(port, "POST", "/v2/repository/models/gridworld/unload", {}, **key)[0] == 200
    assert ask(port, "POST", "/v1/policies/gridworld/act", {"obs": 1})[0] == 404
    assert ask(port, "POST", "/v2/repository/models/gridworld/load", {"parameters": {}}, **key)[0] == 200
    assert ask(port, "POST", "/v1/policies/gridworld/act", {"obs": 1})[0] == 200
    assert ask(port, "POST", "/v2/repository/models/gridworld/unload", {})[0] == 401


@pytest.fixture
def started(policies: Path, key_path: Path, tmp_path: Path) -> Iterator[tuple[AdminClient, int, Path]]:
    """A server started as `rlservo serve DIR` does, with nothing said, over ur5 in 1 and 2."""
    root = tmp_path / "policies"
    for version in ("1", "2"):
        shutil.copytree(policies / "ur5" / version, root / "ur5" / version)
    digest = "sha256:" + hashlib.sha256(read_key(key_path).encode()).hexdigest()
    control = PlanFollower(VersionLoader(Repository([root])), plan_files(root))
    asyncio.run(control.configure({}))
    app = create_app(control, ServerSettings(operator_key=digest), replica="only")
    with over_uvicorn(app) as port, AdminClient(f"http://127.0.0.1:{port}", api_key=read_key(key_path)) as client:
        yield client, port, root


def test_from_the_default_start_on_a_load_changes_no_reply_and_a_rollback_leads_back(
    started: tuple[AdminClient, int, Path], policies: Path, key_path: Path
) -> None:
    admin, port, root = started
    assert act(port)["version"] == "2" and listed(port)["aliases"] == {"production": "2"}
    shutil.copytree(policies / "ur5" / "10", root / "ur5" / "10")
    for load in (
        lambda: admin.load("ur5"),
        lambda: ask(port, "POST", "/v2/repository/models/ur5/load", {}, authorization=f"Bearer {read_key(key_path)}"),
    ):
        load()
        assert act(port)["version"] == "2" and listed(port)["versions"] == ["1", "2", "10"]
    assert act(port, "versions/10/act")["version"] == "10"  # who asks for it gets it
    admin.alias("ur5", "production", "10")
    assert act(port)["version"] == "10"
    with pytest.raises(ConflictError, match="in use by the alias 'production'"):
        admin.unload("ur5", "10")
    admin.unload("ur5", "2")
    admin.rollback("ur5", "production")
    assert act(port)["version"] == "2" and listed(port)["versions"] == ["1", "2", "10"]
    with pytest.raises(ConflictError, match="has no previous version"):
        admin.rollback("ur5", "production")
    with pytest.raises(ConflictError, match="point it elsewhere"):
        admin.alias("ur5", "production", None)


def test_a_policy_unloaded_and_loaded_again_is_served_and_knows_its_way_back(
    started: tuple[AdminClient, int, Path],
) -> None:
    admin, port, root = started
    admin.alias("ur5", "production", "1")
    admin.unload("ur5")
    assert ask(port, "POST", "/v1/policies/ur5/act", {"obs": OBS})[0] == 404
    admin.load("ur5")
    assert act(port)["version"] == "2"
    shutil.rmtree(root / "ur5" / "1")
    shutil.move(write_box_policy(root.parent / "other", version="1", seed=8), root / "ur5" / "1")
    with pytest.raises(RefusedError, match="is not the bundle that was accepted"):  # and not another one of that name
        admin.rollback("ur5", "production")
    assert act(port)["version"] == "2"


def test_administration_needs_the_key_and_acting_does_not(port: int) -> None:
    assert act(port)["version"] == "1"
    for path in ("/v1/admin/recordings", "/v1/admin/policies/ur5/load", "/v2/repository/models/ur5/load"):
        status, reply = ask(port, "POST" if "load" in path else "GET", path, {} if "load" in path else None)
        assert (status, reply["code"]) == (401, "unauthenticated")
    stranger, _ = new_key("stranger", admin=True)
    with AdminClient(f"http://127.0.0.1:{port}", api_key=stranger) as client, pytest.raises(UnauthenticatedError):
        client.recordings()


def test_a_server_without_an_operator_lets_nobody_administer(folder: Path, tmp_path: Path) -> None:
    control = PlanFollower(VersionLoader(Repository([folder / "ur5" / "1"])), plan_files(tmp_path))
    asyncio.run(control.configure({}))
    with over_uvicorn(create_app(control, ServerSettings())) as open_port:
        with (
            AdminClient(f"http://127.0.0.1:{open_port}", api_key="any") as client,
            pytest.raises(ForbiddenError, match="this server has none"),
        ):
            client.unload("ur5")
        assert act(open_port)["version"] == "1"


def test_commands_say_what_is_wrong_with_them(admin: AdminClient) -> None:
    with pytest.raises(UnknownVersionError, match="no version '10': expected one of 1, 2"):
        admin.alias("ur5", "production", "10")
    with pytest.raises(ConflictError, match="in use by the alias 'production'"):
        admin.unload("ur5", "1")
    with pytest.raises(ConflictError, match="has no previous version"):
        admin.rollback("ur5", "production")
    with pytest.raises(RequestError, match="alias"):
        admin.alias("ur5", "10", "1")
    with pytest.raises(RequestError, match="version"):
        admin.load("ur5", "../1")
    with pytest.raises(RequestError, match="share"):
        admin.canary("ur5", "2", 1.5)
    with pytest.raises(RequestError, match="share"):
        parse("canary", {"version": "2", "share": 10**400})  # which no float can hold
    with pytest.raises(RequestError, match="needs a share"):
        admin.canary("ur5", "2")


def test_a_canary_gets_its_share_of_sessions_and_each_session_stays(port: int, admin: AdminClient) -> None:
    admin.canary("ur5", "2", 0.3)
    first = {n: act(port, session_id=f"robot-{n}")["version"] for n in range(200)}
    # 200 draws with p = 0.3: five standard deviations are 32.
    assert abs(Counter(first.values())["2"] - 60) < 33
    assert {n: act(port, session_id=f"robot-{n}")["version"] for n in range(200)} == first
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    for n in range(20):  # the header means the same, under the other protocol, too
        tensor = {"name": "obs", "shape": [1, 27], "datatype": "FP32", "data": OBS}
        connection.request(
            "POST", "/v2/models/ur5/infer", json.dumps({"inputs": [tensor]}), {"x-session-id": f"robot-{n}"}
        )
        assert json.loads(connection.getresponse().read())["model_version"] == first[n]
    connection.close()
    admin.canary("ur5", "2", 0.6)
    grown = {n: act(port, session_id=f"robot-{n}")["version"] for n in range(200)}
    assert all(grown[n] == "2" for n, version in first.items() if version == "2")  # a larger share keeps those it had
    assert abs(Counter(grown.values())["2"] - 120) < 35
    assert {act(port)["version"] for _ in range(100)} == {"1", "2"}  # without a session every request is drawn
    assert {act(port, "versions/1/act", session_id=f"robot-{n}")["version"] for n in range(50)} == {"1"}
    admin.canary("ur5", None)
    assert {act(port, session_id=f"robot-{n}")["version"] for n in range(50)} == {"1"}


def test_a_shadow_computes_along_and_only_its_difference_is_kept(port: int, admin: AdminClient, folder: Path) -> None:
    admin.shadow("ur5", "2")
    with Policy.load(folder / "ur5" / "1") as one, Policy.load(folder / "ur5" / "2") as two:
        expected = float(np.abs(one.act(OBS) - two.act(OBS)).max())
        reply = act(port)
        np.testing.assert_allclose(reply["action"], one.act(OBS), rtol=1e-6)
    for _ in range(9):
        act(port)
    act(port, explore=True, seed=1)  # differs by chance: not compared
    act(port, "versions/2/act")  # not the default version's
    ask(port, "POST", "/v1/policies/ur5/act", {"obs": [OBS] * 5})
    labels = 'policy="ur5",replica="only",shadow="2",version="1"'
    deadline = time.monotonic() + 30
    while f"rlservo_shadow_difference_count{{{labels}}} 15.0" not in (text := ask(port, "GET", "/metrics")[1]):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert listed(port)["shadow"] == {"version": "2"}
    total = next(line for line in text.splitlines() if line.startswith(f"rlservo_shadow_difference_sum{{{labels}}}"))
    assert float(total.split()[-1]) == pytest.approx(15 * expected, rel=1e-5)
    missed = 'rlservo_shadow_missed_total{policy="ur5",reason="failed",replica="only",shadow="2",version="1"}'
    assert f"{missed} 0.0" in text
    admin.shadow("ur5", None)
    assert listed(port)["shadow"] is None


def test_metrics_name_versions_and_not_aliases(port: int, admin: AdminClient) -> None:
    admin.alias("ur5", "candidate", "2")
    act(port, "versions/candidate/act")
    ask(port, "POST", "/v1/policies/ur5/versions/candidate/act", {"obs": [1]})
    _, text = ask(port, "GET", "/metrics")
    assert 'code="ok",policy="ur5",protocol="json",replica="only",version="2"' in text
    assert 'code="bad-observation",policy="ur5",protocol="json",replica="only",version="2"' in text
    assert "candidate" not in text
    assert 'rlservo_policy_loaded{policy="ur5",replica="only",version="1"} 1.0' in text
    assert 'rlservo_policy_loaded{policy="ur5",replica="only",version="2"} 0.0' in text


def run(port: int, key_path: Path, *arguments: str) -> str:
    options = ["--url", f"http://127.0.0.1:{port}", "--key-file", str(key_path)]
    result = CliRunner().invoke(command_line, ["policy", *arguments, *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_the_command_line_does_all_of_it(port: int, key_path: Path) -> None:
    assert "loaded 1, 2, 10" in run(port, key_path, "load", "ur5", "10")
    assert "default 10" in run(port, key_path, "alias", "ur5", "production=10")
    assert "default 1" in run(port, key_path, "rollback", "ur5")
    assert "canary 2 gets 0.1 of the sessions" in run(port, key_path, "canary", "ur5", "2=0.1")
    assert "shadow 10" in run(port, key_path, "shadow", "ur5", "10")
    assert "canary" not in run(port, key_path, "canary", "ur5", "off")
    assert "shadow" not in run(port, key_path, "shadow", "ur5", "off")
    assert "loaded 1, 2;" in run(port, key_path, "unload", "ur5", "10")
    assert "production" in run(port, key_path, "list")
    assert json.loads(run(port, key_path, "list", "--json"))[0]["generation"] == 9
    with pytest.raises(UsageError, match="expected something like production=4"):
        run(port, key_path, "alias", "ur5", "production")


def test_the_command_line_names_the_file_of_a_wrong_key(port: int, tmp_path: Path) -> None:
    file = tmp_path / "operator.key"
    for text, sentence in (
        (new_key("stranger", admin=True)[0], f"does not know the key in {file}: expected one of that server's keys"),
        ("operator admin sha256:00", f"the key file {file} does not hold a key: expected"),
        ("ключ", f"the key file {file} does not hold a key: expected"),
    ):
        file.write_text(text)
        with pytest.raises((UnauthenticatedError, UsageError)) as caught:
            run(port, file, "unload", "ur5")
        assert sentence in caught.value.message
    file.write_text(new_key("stranger", admin=True)[0])
    promote = ["promote", "ur5", "2", "--max-error-rate", "1%", "--log", str(tmp_path / "log.jsonl")]
    result = CliRunner().invoke(
        command_line, ["policy", *promote, "--url", f"http://127.0.0.1:{port}", "--key-file", str(file)]
    )
    assert f"does not know the key in {file}: expected" in f"{result.output}{result.exception}"


def test_the_operators_key_is_for_this_user_alone_and_goes_with_the_server(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = f"http://127.0.0.1:{port}"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RLSERVO_ADMIN_KEY", raising=False)
    file = key_file(8000)
    file.parent.mkdir(mode=0o700)
    file.symlink_to(tmp_path / "elsewhere")
    with written_key(file, "abcdef") as is_written:
        assert is_written and not file.is_symlink() and stat.S_IMODE(file.stat().st_mode) == 0o600
        assert find_key("http://127.0.0.1:8000", None) == read_key(file) == "abcdef"
        with pytest.raises(UsageError, match="needs an admin key"):
            find_key(server, None)
    assert not file.exists() and not (tmp_path / "elsewhere").exists()
    with pytest.raises(UsageError, match="needs an admin key"):
        find_key(server, None)
    monkeypatch.setenv("RLSERVO_ADMIN_KEY", "abc")
    assert find_key("http://robot:8000", None) == "abc"


def test_serve_takes_versions_from_a_file_and_options_win(tmp_path: Path) -> None:
    file = tmp_path / "served.yaml"
    file.write_text("policies:\n  ur5: {versions: [1, 2], aliases: {production: 1}}\nunlisted: ignore\n")
    document = served_config(file, None, ["ur5:production=2", "mir:production=7"], ["ur5:1=0.2"], ["ur5=1"])
    assert document == {
        "policies": {
            "ur5": {
                "versions": [1, 2],
                "aliases": {"production": "2"},
                "canary": {"version": "1", "share": 0.2},
                "shadow": "1",
            },
            "mir": {"aliases": {"production": "7"}},
        },
        "unlisted": "ignore",
    }
    assert served_config(None, ["ur5=3,4"], None, None, None) == {"policies": {"ur5": {"versions": ["3", "4"]}}}
    for wrong in ("ur5", "ur5:production", "=3"):
        with pytest.raises(UsageError, match="expected something like"):
            served_config(None, None, [wrong], None, None)
    with pytest.raises(
        UsageError, match=r"policies\.ur5\.versions\.0: expected a version such as 3 or 1\.2\.0 \(given"
    ):
        ServedConfig.parse(served_config(None, ["ur5=abc"], None, None, None))
    with pytest.raises(UsageError, match=r"^--versions 'ur5=1,ur5=2': expected one policy, such as ur5=3,4"):
        served_config(None, ["ur5=1,ur5=2"], None, None, None)
    for given in ((["p=1", "p=2"], None, None, None), (None, None, ["p:1=0.1", "p:2=0.1"], None)):
        with pytest.raises(UsageError, match=r"^--(versions|canary) names policy 'p' twice: expected it once$"):
            served_config(None, *given)
    file.write_text("a: [")
    with pytest.raises(UsageError, match="cannot be read"):
        served_config(file, None, None, None, None)
    file.write_text("[1]")
    with pytest.raises(UsageError, match="expected a map whose 'policies' is a map"):
        served_config(file, None, None, None, None)
