"""The wheel is what users get: it is built, compared with the tree, and installed alone in a clean environment."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from environments import virtual_environment

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("rlservo", "envs", "export", "serve_app", "deploy")


def test_wheel_holds_every_module_and_asset_and_no_foreign_top_level(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    top_level = {name.split("/")[0] for name in names}
    info = next(name for name in top_level if name.endswith(".dist-info"))
    data = info.replace(".dist-info", ".data")  # what ros2 run looks for
    assert top_level == {"rlservo", info, data}
    assert {name.split("/")[2] for name in names if name.startswith(data)} == {"lib", "share"}
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.match("kuberay/secrets*.yaml") and path.name != "secrets.example.yaml":
                continue  # this checkout's own
            if path.suffix in {".py", ".yaml", ".html", ".css", ".js", ".svg"} or path.name == "py.typed":
                inside = path.relative_to(ROOT / "rlservo" if folder == "rlservo" else ROOT)
                assert f"rlservo/{inside}" in names


def test_metadata_installs_no_developers_tools_and_has_no_placeholder(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read(next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))).decode()
    head, _, readme = text.partition("\n\n")
    everything = [line for line in head.splitlines() if line.endswith('extra == "all"')]
    assert everything == [
        "Requires-Dist: rlservo[client,cockpit,hub,ray,record,remote,rosbridge,serve,sign,sim,tracing,train,ur]; "
        'extra == "all"',
        'Requires-Dist: minari>=0.5; python_version >= "3.11" and extra == "all"',
    ]
    assert "<this repository>" not in readme


@pytest.mark.slow
def test_wheel_alone_gives_the_in_process_runtime(wheel: Path, tmp_path: Path) -> None:
    python = virtual_environment("-c", ROOT / "constraints.txt", wheel, name="wheel")

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)

    listed = run(sys.executable, "-m", "pip", "--python", str(python), "list", "--format=freeze").stdout.lower()
    assert "\nonnxruntime==" in f"\n{listed}"
    for heavy in ("torch", "ray", "gymnasium", "mujoco", "fastapi", "onnx"):
        assert f"\n{heavy}==" not in f"\n{listed}"
    loaded = run(str(python), "-c", "import rlservo; print(rlservo.__version__, rlservo.Policy.load, rlservo.rollout)")
    assert loaded.returncode == 0, loaded.stderr
    extras = {"PolicyClient": "client", "StreamClient": "client", "Recorder": "record", "export_checkpoint": "train"}
    for name, extra in extras.items():
        missing = run(str(python), "-c", f"from rlservo import {name}").stderr
        assert f"pip install '.[{extra}]'" in missing.splitlines()[-1], missing
    rlservo = str(python.with_name("rlservo"))
    assert run(rlservo, "--version").stdout.startswith("rlservo ")
    refused = run(rlservo, "serve", ".")
    assert refused.returncode == 2
    assert "pip install '.[serve]'" in refused.stderr
    assert "Traceback" not in refused.stderr
    for folder in FOLDERS[1:]:
        assert run(str(python), "-c", f"import {folder}").returncode != 0
