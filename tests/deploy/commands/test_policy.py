"""`rlservo policy ... --repository`: the plan of a repository changed without a server, and what goes wrong with it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from command_line import rlservo_here

RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]


@pytest.fixture
def repository(policies: Path, tmp_path: Path) -> Path:
    """ur5 in 1, 2 and 10."""
    return Path(shutil.copytree(policies / "ur5", tmp_path / "policies" / "ur5")).parent


def give(repository: Path, *words: str, code: int = 0) -> str:
    done = rlservo_here("policy", *words, "--repository", repository)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stderr if code else done.stdout


def test_every_command_is_carried_out_and_told(repository: Path, policies: Path) -> None:
    assert "no plan yet" in give(repository, "list") and "not loaded" in give(repository, "list")
    assert "default 2, loaded 1, 2, 10" in give(repository, "alias", "ur5", "production=2")
    assert "production=2, candidate=10" in give(repository, "alias", "ur5", "candidate=10")
    assert "canary candidate gets 0.1 of the sessions" in give(repository, "canary", "ur5", "candidate=0.1")
    assert "shadow 1" in give(repository, "shadow", "ur5", "1")
    assert "plan 5" in give(repository, "shadow", "ur5", "off")
    rolled_back = give(repository, "rollback", "ur5")
    assert "default 10, loaded 1, 2, 10; aliases production=10, candidate=10; canary" in rolled_back
    assert f"plan 6 in {repository}/.plan" in rolled_back
    assert "loaded 2, 10" in give(repository, "unload", "ur5", "1")
    shown = give(repository, "list")
    assert "plan 7 (unload ur5 1," in shown and "production, candidate, canary" in shown
    listing = json.loads(give(repository, "list", "--json"))
    (ur5,) = listing["policies"]
    assert (listing["generation"], ur5["versions"], ur5["not_loaded"]) == (7, ["2", "10"], ["1"])
    assert "loaded 1, 2, 10" in give(repository, "load", "ur5", "1")


def test_what_is_wrong_is_one_sentence_and_changes_nothing(repository: Path) -> None:
    give(repository, "alias", "ur5", "production=2")
    (repository / "ur5" / "1" / "policy.onnx").write_bytes(b"broken")
    for words, sentence, code in (
        (("alias", "ur5", "production=1"), "refused, and nothing has changed: ", 1),
        (("alias", "ur5", "production=3"), "policy 'ur5' has no version '3': expected one of 1, 2, 10", 1),
        (("alias", "mir", "production=3"), "no policy 'mir' is loaded: this server has ur5", 1),
        (("canary", "ur5", "1=7"), "canary: share: Input should be less than or equal to 1", 2),
        (("load", "ur5", "../1"), "load: version: ", 2),
        (("rollback", "ur5", "--alias", "candidate"), "has no previous version to roll back to", 1),
    ):
        assert sentence in give(repository, *words, code=code)
    assert len(list((repository / ".plan").iterdir())) == 1
    assert "does not exist: expected a policy bundle" in give(repository / "nothing", "list", code=1)


def test_of_two_operators_processes_at_once_one_wins_and_the_other_is_told(repository: Path) -> None:
    give(repository, "alias", "ur5", "production=1")
    for _ in range(3):
        racing = [
            subprocess.Popen(
                [*RLSERVO, "policy", "alias", "ur5", f"production={version}", "--repository", str(repository)],
                stderr=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for version in ("2", "10")
        ]
        outcomes = [(*process.communicate(timeout=60), process.returncode) for process in racing]
        assert {code for _, _, code in outcomes} <= {0, 1} and any(code == 0 for *_, code in outcomes)
        for out, err, code in outcomes:
            assert "another command came first (plan" in err if code else "plan" in out, (out, err)
    plans = [json.loads(file.read_text()) for file in sorted((repository / ".plan").iterdir())]
    assert [plan["generation"] for plan in plans] == list(range(1, len(plans) + 1))
