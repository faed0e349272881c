"""The public names of `import rlservo`: their list and what each imports; `make check` checks their types."""

from __future__ import annotations

import ast
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import rlservo

ROOT = Path(__file__).resolve().parent.parent
NAMES = [
    "ActingPolicy",
    "AdminClient",
    "CompiledPolicy",
    "Policy",
    "PolicyClient",
    "Recorder",
    "StreamClient",
    "WithFallback",
    "WithRecording",
    "__version__",
    "errors",
    "export_checkpoint",
    "export_policy",
    "rollout",
]


def python(program: str, *words: object, cwd: Path = ROOT) -> str:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program), *map(str, words)],
        capture_output=True, text=True, timeout=300, cwd=cwd,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_public_names_are_all_there_and_nothing_else() -> None:
    pytest.importorskip("torch")  # the exporter's, which `make newest` does not install
    assert rlservo.__all__ == NAMES == dir(rlservo)
    for name in NAMES:
        assert getattr(rlservo, name) is not None
    assert rlservo.Policy.__module__.startswith("rlservo.") and rlservo.Policy.__name__ == "Policy"
    assert issubclass(rlservo.errors.UsageError, rlservo.errors.RlservoError)
    assert isinstance(rlservo.__version__, str) and rlservo.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="module 'rlservo' has no attribute 'Polcy'"):
        rlservo.Polcy  # type: ignore[attr-defined]  # noqa: B018


def test_examples_take_public_names_from_rlservo_itself() -> None:
    pytest.importorskip("torch")
    named = {name: getattr(rlservo, name) for name in NAMES if not name.startswith("__")}
    inside = {f"{each.__module__}.{name}" for name, each in named.items() if name != "errors"}  # it is a module
    assert "rlservo.policy.policy.Policy" in inside
    for file in sorted((ROOT / "examples").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                names = {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
                assert not names & inside, f"{file.relative_to(ROOT)}, line {node.lineno}"


@pytest.mark.parametrize("folder", [ROOT, Path("/")], ids=["in the checkout", "elsewhere"])
def test_importing_it_imports_nothing(folder: Path) -> None:
    program = """
        import sys
        before = set(sys.modules)
        import rlservo
        print(sorted(set(sys.modules) - before))
        print(sorted(name for name in before if name.startswith("rlservo")))
    """
    assert python(program, cwd=folder).splitlines() == ["['rlservo']", "[]"]


def test_first_action_needs_no_event_loop_and_no_server(shipped: Path) -> None:
    program = """
        import os, sys, time
        os.environ["ORT_DISABLE_TELEMETRY"] = "1"
        import numpy, onnxruntime
        before, began = set(sys.modules), time.process_time()
        import rlservo
        action = rlservo.Policy.load(sys.argv[1]).act(numpy.zeros(27, numpy.float32))
        spent = time.process_time() - began
        assert action.shape == (5,), action
        print(f"{spent:.3f}", *sorted({name.partition(".")[0] for name in set(sys.modules) - before}))
    """
    spent, *modules = python(program, shipped / "ur5").split()
    print(f"from numpy and onnxruntime to the first action: {spent} s of CPU time")
    unwanted = {"asyncio", "fastapi", "gymnasium", "httptools", "httpx", "multiprocessing", "ray", "rich", "ssl",
                "starlette", "torch", "typer", "websockets"}  # fmt: skip
    assert "pydantic" in modules and not unwanted & set(modules)
