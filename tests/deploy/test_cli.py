"""The command line as a user types it: real commands, their output, their exit codes, their one-sentence errors.

Each kind of command runs once in its own process, all others in this one (command_line.py).
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from bundles import rewrite_contract, write_box_policy
from command_line import rlservo, rlservo_here
from rlservo.bundle.bundle import load_bundle, read_contract
from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.deploy.commands.environment_options import parse_env_arguments
from rlservo.errors import UsageError
from rlservo.policy.compiled_policy import CompiledPolicy
from rlservo.policy.policy import Policy
from servers import free_ports

ROOT = Path(__file__).resolve().parents[2]
UR5 = ROOT / "examples" / "checkpoints" / "ur5_positioning"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """The UR5 policy, exported by the command line into a repository."""
    done = rlservo("export", UR5, "--out", tmp_path_factory.mktemp("policies"), "--name", "ur5", "--json")
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def policies(exported: subprocess.CompletedProcess[str]) -> Path:
    """That repository."""
    return Path(json.loads(exported.stdout)["path"]).parents[1]


@pytest.fixture
def bundle(policies: Path, tmp_path: Path) -> Path:
    """A copy of the bundle to spoil."""
    return Path(shutil.copytree(policies / "ur5" / "1", tmp_path / "ur5" / "1"))


def refused(done: subprocess.CompletedProcess[str], code: int, *fragments: str) -> None:
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("rlservo: ")]
    assert len(errors) == 1, done.stderr
    for fragment in fragments:
        assert fragment in errors[0]


def test_export_says_what_it_proved_and_where_it_wrote(tmp_path: Path) -> None:
    began = time.monotonic()
    done = rlservo_here("export", UR5, "--out", tmp_path, "--name", "arm", "--version", "1.2.0")
    assert done.returncode == 0, done.stderr
    print(f"export took {time.monotonic() - began:.1f} s")
    assert str(tmp_path / "arm" / "1.2.0") in done.stdout
    assert done.stderr.count("checkpoints are pickles and run code when loaded") == 1
    assert "MB at the peak" in done.stdout
    files = {path.name for path in (tmp_path / "arm" / "1.2.0").iterdir()}
    assert files == {"policy.onnx", "policy.ts", "contract.json", "golden.npz", "SHA256SUMS"}
    checked = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=tmp_path / "arm" / "1.2.0", capture_output=True)
    assert checked.returncode == 0


def test_export_as_json_prints_one_document(exported: subprocess.CompletedProcess[str]) -> None:
    document = json.loads(exported.stdout)
    assert Path(document["path"]).is_dir()
    assert 0 < document["seconds"] < 300 and 50 < document["peak_memory_mb"] < 5000
    assert document["contract"]["observation_space"]["elements"][0] == {
        "name": "target_r", "unit": "m", "quantity": "distance", "frame": "tool0"
    }  # fmt: skip
    assert document["contract"]["control_rate_hz"] == 10.0


def test_all_modules_of_a_checkpoint_behind_a_uri_are_exported_as_one_list(tmp_path: Path) -> None:
    done = rlservo_here("export", UR5.as_uri(), "--out", tmp_path, "--all-modules", "--json")
    assert done.returncode == 0, done.stderr
    (document,) = json.loads(done.stdout)
    assert Path(document["path"]) == tmp_path / "end-effector-positioning-ur" / "1"
    assert f"loading {UR5.as_uri()}: checkpoints are pickles" in done.stderr
    refused(
        rlservo_here("export", UR5, "--out", tmp_path, "--all-modules", "--module-id", "m", "--output", "a=b"),
        2,
        "--all-modules exports every module: leave --module-id and --output out",
    )


@pytest.mark.parametrize(
    "option", ["--vecnormalize=a.pkl", "--frame-stack=4", "--joint-order=a", "--action-range=-1,1", "--output=a=action"]
)
def test_option_of_another_source_is_refused(tmp_path: Path, option: str) -> None:
    done = rlservo_here("export", UR5, "--out", tmp_path / "out", option)
    refused(done, 2, f"{option.split('=')[0]} is not for rllib checkpoints: leave it out")
    assert not (tmp_path / "out").exists()


def test_inspect_shows_names_units_and_proof(policies: Path) -> None:
    done = rlservo("inspect", policies)
    assert done.returncode == 0
    for text in ("target_r", "rad/s", "base_position_normalized", "mean_std_filter", "torchscript"):
        assert text in done.stdout
    document = json.loads(rlservo_here("inspect", policies, "--json").stdout)
    assert document["name"] == "ur5"


def test_control_characters_of_names_do_not_reach_the_terminal(tmp_path: Path) -> None:
    bundle = write_box_policy(tmp_path)
    space = read_contract(bundle).observation_space
    assert isinstance(space, BoxSpec)
    first = Element(name="\x1b]0;owned\x07\x1b[2J\x9b31m", unit="rad\x1b[8m")
    elements = (first, *space.elements[1:])
    rewrite_contract(bundle, observation_space=space.model_copy(update={"elements": elements}))
    shown = rlservo_here("inspect", bundle).stdout
    assert "\\x1b]0;owned" in shown
    assert not set(shown) & {chr(code) for code in (*range(10), *range(11, 32), *range(127, 160))}


def test_verify_proves_the_bundle_again(policies: Path) -> None:
    done = rlservo("verify", policies, "--checkpoint", UR5)
    assert done.returncode == 0, done.stderr


def test_verify_refuses_another_policys_checkpoint(policies: Path) -> None:
    done = rlservo_here("verify", policies, "--checkpoint", UR5.parent / "mir100_navigation")
    refused(done, 2, "shape (27,), but the checkpoint's have (4,): they do not belong together")


def test_verify_measures_disturbances_and_writes_them_into_the_contract(bundle: Path, tmp_path: Path) -> None:
    plot = tmp_path / "table.png"
    words = ("verify", bundle, "--env", "rlservo/EndEffectorPositioningURSim-v0", "--disturb")
    done = rlservo_here(
        *words, "latency=2", "noise=real,payload=1", "--episodes", 2, "--json", "--write", "--plot", plot
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["disturbances"]["rows"]
    assert [row["disturbance"] for row in rows] == ["none", "latency=2", "noise=real,payload=1"]
    assert rows[0]["step_sizes"]["rad/s"]["largest"] > 0 and plot.stat().st_size > 2000
    assert "latency=2 (2 of 3): " in done.stderr
    evaluations = load_bundle(bundle).contract.evaluations  # the hashes fit the new contract
    assert [one.disturbance for one in evaluations] == ["none", "latency=2", "noise=real,payload=1"]
    assert rlservo_here("inspect", bundle).returncode == 0
    with Policy.load(bundle) as policy:  # a server's check of the copy inside the graph
        assert policy.contract.evaluations == evaluations


@pytest.fixture(scope="module")
def compiled(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy as C. Not to be written to."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("compiled") / "c"
    done = rlservo_here("compile", policies, "--out", folder)
    assert done.returncode == 0, done.stderr
    assert "µs for the slowest observation" in done.stdout and "bytes stack" in done.stdout
    return folder


REACH = ("--env", "rlservo/EndEffectorPositioningURSim-v0", "--episodes", 2)


def test_verify_drives_bundle_and_c_to_the_same_endings(policies: Path, compiled: Path) -> None:
    done = rlservo_here("verify", policies, "--compiled", compiled, *REACH, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)["compiled"]
    assert (document["episodes"], sum(document["endings"].values())) == (2, 2)
    assert document["max_return_difference"] < 1e-3


def test_verify_finds_c_that_ends_otherwise(policies: Path, compiled: Path, tmp_path: Path) -> None:
    """As a weight that was changed after the proof: the hashes fit, the arm stands still."""
    copy = shutil.copytree(compiled, tmp_path / "c")
    source = (copy / "ur5.c").read_text()
    (copy / "ur5.c").write_text(
        source.replace("    return notice;", "    memset(action, 0, sizeof *action);\n    return 0;")
    )
    subprocess.run(
        ["cc", "-std=c99", "-O1", "-shared", "-fPIC", "ur5.c", "-o", "libur5.so", "-lm"], cwd=copy, check=True
    )
    about = json.loads((copy / "compile.json").read_text())
    about["files"]["libur5.so"] = hashlib.sha256((copy / "libur5.so").read_bytes()).hexdigest()
    (copy / "compile.json").write_text(json.dumps(about))
    done = rlservo_here("verify", policies, "--compiled", copy, *REACH)
    refused(done, 1, "episode 0 (seed 0) ends differently: with the bundle 'success' after ", "with its C code '")


def test_rollout_replay_and_the_cockpit_drive_the_compiled_policy(compiled: Path, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    done = rlservo_here("rollout", *REACH[1:], "--bundle", compiled, "--seed", 0, "--record", run, "--json")
    assert done.returncode == 0, done.stderr
    done = rlservo_here("replay", run, "--bundle", compiled, "--json")
    assert done.returncode == 0, done.stdout + done.stderr  # no action would change
    assert json.loads(done.stdout)["compared"] > 0
    from rlservo.deploy.cockpit.policies import BundledPolicies, Choice, ServerLink

    with BundledPolicies(compiled).open(Choice("ur5", "1"), ServerLink()) as policy:
        assert isinstance(policy, CompiledPolicy)


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        ((), "expected --checkpoint to compare the bundle with, or --env with --disturb or --compiled"),
        (("--disturb", "--source", "sb3"), "--source and --vecnormalize need --checkpoint"),
        (("--disturb",), "--disturb needs --env"),
        (("latency=2", "--env", "CartPole-v1"), "need --disturb"),
        (("--disturb", "wind=3", "--env", "CartPole-v1"), "'wind=3': expected KIND=SIZE"),
        (
            ("--disturb", "payload=3", "--env", "rlservo/NoObstacleNavigationMir100Sim-v0", "--env-arg", "ur_model=0"),
            "cannot be made",
        ),
        (("--disturb", "--plot", "nowhere/x.png", "--env", "CartPole-v1"), "'nowhere' does not exist"),
    ],
)
def test_wrong_use_of_disturb_exits_with_2(policies: Path, words: tuple[str, ...], fragment: str) -> None:
    refused(rlservo_here("verify", policies, *words), 2, fragment)


def test_rollout_in_process_reports_success_as_json(policies: Path) -> None:
    done = rlservo(
        "rollout", "rlservo/EndEffectorPositioningURSim-v0", "--bundle", policies, "--episodes", 4, "--seed", 700,
        "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["successes"] >= 3
    assert [row["seed"] for row in report["episodes"]] == list(range(700, 704))
    assert report["latency_ms"]["p50"] < report["deadline_ms"] == 100.0


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("export", "nowhere", "--out", "x"), ("nowhere", "does not exist")),
        (("export", ROOT / "envs", "--out", "x"), ("envs", "checkpoint")),
        (("export", ROOT / "README.md", "--out", "x"), ("README.md",)),
        (("inspect", "nowhere"), ("nowhere does not exist: expected a policy bundle",)),
        (("inspect", ROOT / "envs"), ("holds no policy bundle", "contract.json")),
    ],
)
def test_wrong_path_is_one_sentence(words: tuple[object, ...], fragments: tuple[str, ...], tmp_path: Path) -> None:
    refused(rlservo_here(*words, cwd=tmp_path), 1, *fragments)
    assert not (tmp_path / "x").exists()


def test_changed_byte_is_refused(bundle: Path) -> None:
    onnx = bundle / "policy.onnx"
    content = bytearray(onnx.read_bytes())
    content[len(content) // 2] ^= 1
    onnx.write_bytes(content)
    refused(rlservo("inspect", bundle), 1, "policy.onnx is not the file that was exported")


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (("rollout", "CartPole-v1"), "expected either --url (a server) or --bundle"),
        (("rollout", "NoSuchEnv-v0", "--bundle", "{bundle}"), "NoSuchEnv"),
        (("rollout", "CartPole-v1", "--bundle", "{bundle}"), "CartPole-v1"),
        (("rollout", "CartPole-v1", "--bundle", "{bundle}", "--env-arg", "x"), "expected NAME=VALUE"),
    ],
)
def test_wrong_use_of_rollout_exits_with_2(policies: Path, words: tuple[str, ...], fragment: str) -> None:
    refused(rlservo_here(*(word.format(bundle=policies) for word in words)), 2, fragment)


def test_rollout_without_a_server_says_so(policies: Path) -> None:
    words = ("rollout", "rlservo/EndEffectorPositioningURSim-v0", "--url", "http://127.0.0.1:9", "--policy", "x")
    refused(rlservo_here(*words), 1, "http://127.0.0.1:9 cannot be reached")


def test_serve_refuses_a_broken_bundle_before_anything_starts(bundle: Path) -> None:
    (bundle / "golden.npz").unlink()
    began = time.monotonic()
    broken = rlservo("serve", bundle.parent)
    refused(broken, 1, "golden.npz")
    assert time.monotonic() - began < 60.0  # a second, on an idle machine
    for done in (broken, rlservo("serve", "nope")):
        assert done.returncode != 0 and "starting" not in done.stdout + done.stderr, done.stderr


def test_every_command_has_help_with_an_example() -> None:
    for command in ("export", "prune", "inspect", "verify", "serve", "rollout", "demo"):
        done = rlservo_here(command, "--help")
        assert done.returncode == 0
        assert "Example" in done.stdout


@pytest.mark.parametrize("words", [("list",), ("load", "ur5"), ("promote", "ur5", "2", "--max-error-rate", "1%")])
def test_a_server_that_is_down_is_the_fault_not_a_missing_key(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RLSERVO_ADMIN_KEY", raising=False)
    (port,) = free_ports(1)
    done = rlservo_here("policy", *words, "--url", f"http://127.0.0.1:{port}", cwd=tmp_path)
    assert f"http://127.0.0.1:{port} cannot be reached" in done.stderr and "`rlservo serve`" in done.stderr
    assert done.returncode != 0 and "admin key" not in done.stderr


def test_serve_refuses_a_default_policy_that_is_not_served(policies: Path) -> None:
    done = rlservo("serve", policies, "--default-policy", "mir100")
    refused(done, 2, "the default policy 'mir100' is not served: expected ur5")
    assert "starting" not in done.stderr


HEAVY = {"asyncio", "fastapi", "grpc", "gymnasium", "httptools", "httpx", "mujoco", "numpy", "onnxruntime", "ray",
         "rich", "starlette", "torch"}  # fmt: skip
MODULES_OF = """
import json, sys
from rlservo.deploy.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["rlservo", *words]
    try:
        main()
    except SystemExit as end:
        assert not end.code, words
    print("MODULES", *sorted({name.split(".")[0] for name in sys.modules}), file=sys.stderr)
"""


def modules_of(*commands: tuple[object, ...]) -> list[set[str]]:
    """Run commands in one process; return for each the top-level modules that it and those before it have imported."""
    words = json.dumps([[str(word) for word in command] for command in commands])
    done = subprocess.run([sys.executable, "-c", MODULES_OF, words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    found = [set(line.split()) for line in done.stderr.splitlines() if line.startswith("MODULES ")]
    assert len(found) == len(commands)
    return found


def test_help_imports_nothing_that_takes_time(policies: Path) -> None:
    plain = [
        ("--help",), ("--version",),
        *((command, "--help") for command in
          ("export", "prune", "inspect", "verify", "serve", "key", "rollout", "demo", "server-manager")),
        ("policy", "load", "--help"), ("policy", "promote", "--help"),
        ("robot-server", "ur", "--help"),

    ]  # fmt: skip
    imported = modules_of(*plain, ("key", "cell-7"), ("inspect", policies))
    assert not imported[0] & {*HEAVY, "pydantic", "importlib.metadata"}
    # pydantic is typer's own for the options of a command.
    for words, modules in zip(plain, imported, strict=False):
        assert not modules & HEAVY, words
    assert not imported[-2] & (HEAVY - {"rich"})
    assert not imported[-1] & (HEAVY - {"rich", "numpy"})


def test_lists_of_commands_are_whole_sentences() -> None:
    for group in ((), ("policy",), ("robot-server",), ("log",)):
        listed = rlservo_here(*group, "--help").stdout.partition("Commands:")[2].splitlines()
        assert len(listed) > 1 and all(line.endswith(".") and "..." not in line for line in listed if line), listed


def test_unknown_command_and_option_exit_with_2() -> None:
    assert rlservo("deploy").returncode == 2
    assert rlservo_here("inspect", "--colour", "red").returncode == 2


def test_prune_writes_a_smaller_copy(tmp_path: Path) -> None:
    done = rlservo("prune", UR5, "--out", tmp_path / "small")
    assert done.returncode == 0 and list((tmp_path / "small").rglob("module_state*")), done.stderr


def test_env_arguments_are_json_or_strings() -> None:
    parsed = parse_env_arguments(["ur_model=ur10e", "randomize_start=true", "rate=2.5", 'a="b"'])
    assert parsed == {"ur_model": "ur10e", "randomize_start": True, "rate": 2.5, "a": "b"}
    with pytest.raises(UsageError, match="expected NAME=VALUE"):
        parse_env_arguments(["ur-model=ur5"])


def test_key_makes_a_key_and_the_line_that_the_server_accepts_it_by() -> None:
    from rlservo.serve_app.server.api_keys import Keys, Role
    from rlservo.serve_app.server.settings import ServerSettings

    done = rlservo("key", "operator", "--admin", "--json")
    assert done.returncode == 0, done.stderr
    made = json.loads(done.stdout)
    found = Keys.from_settings(ServerSettings(api_keys=made["line"])).find(made["key"].encode())
    assert found is not None and (found.label, found.role) == ("operator", Role.admin)
    plain = rlservo_here("key", "cell-7").stdout.split("\n")
    assert plain[0].startswith("rlservo_") and plain[1].startswith("cell-7 act sha256:")
    assert rlservo_here("key", "cell-8", "--explore").stdout.split("\n")[1].startswith("cell-8 explore sha256:")
    refused(rlservo_here("key", "two words"), 2, "label 'two words': expected 1 to 64 letters")


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        ((), "no limit was given: give --max-error-rate, --max-p99"),
        (("--max-error-rate", "0.1"), "--max-error-rate '0.1': expected a number with its unit, such as 0.1%"),
        (("--max-error-rate", "101%"), "at most 100%"),
        (("--max-p99", "20"), "--max-p99 '20': expected a number with its unit, such as 20ms"),
        (("--max-p99", "2s"), "at most 1 s"),
        (("--max-success-drop", "-1%"), "--max-success-drop '-1%'"),
        (("--max-p99", "20ms", "--canary", "0"), "--canary 0, --for 10m: expected both above 0"),
        (("--max-p99", "20ms", "--canary", "110%"), "--canary '110%'"),
        (("--max-p99", "20ms", "--for", "31d"), "--for '31d'"),
        (("--max-p99", "20ms", "--url", "http://127.0.0.1:9"), "http://127.0.0.1:9 cannot be reached"),
    ],
)
def test_a_promotion_that_cannot_begin_exits_with_2_and_leaves_no_log(
    words: tuple[str, ...], fragment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RLSERVO_ADMIN_KEY", "x")
    refused(rlservo_here("policy", "promote", "ur5", "2", *words, cwd=tmp_path), 2, fragment)
    assert list(tmp_path.iterdir()) == []
