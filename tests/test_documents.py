"""Documents: as wide as the code, and with all that the command line and the protocols have."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import typer

from rlservo.deploy.cli import app
from rlservo.serve_app.episodes.request import REQUEST_FIELDS
from rlservo.serve_app.protocols import oip_grpc

ROOT = Path(__file__).resolve().parent.parent
CARDS = ROOT / "examples" / "checkpoints"  # their tables of figures are written by evaluate_shipped.py
MAX_COLUMNS = 120


def documents() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True)
    names = listing.stdout.split() or [str(path.relative_to(ROOT)) for path in ROOT.glob("[!.]*/**/*.md")]
    return [ROOT / name for name in sorted(names)]


@pytest.mark.parametrize("document", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_line_of_a_document_is_beyond_120_columns(document: Path) -> None:
    lines = document.read_text(encoding="utf-8").splitlines()
    if CARDS in document.parents and document.parent != CARDS:
        lines = ["" if line.startswith("|") else line for line in lines]
    assert [f"line {number}: {len(line)}" for number, line in enumerate(lines, 1) if len(line) > MAX_COLUMNS] == []


def test_documents_are_found() -> None:
    assert {ROOT / "README.md", ROOT / "docs" / "decisions.md", ROOT / "examples" / "robo_gym.md"} <= set(documents())


def section(document: str, heading: str) -> str:
    """Return a document's section, its lines joined."""
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    return " ".join(text.split(f"\n## {heading}\n")[1].split("\n## ")[0].split())


def test_the_operations_document_names_every_command() -> None:
    text = section("operations.md", "The command line")
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        assert f"`rlservo {name}" in text, name
        for part in getattr(command, "commands", ()):
            assert part in re.split(r"[ |]", text.split(f"`rlservo {name} ")[1].split("`")[0]), f"{name} {part}"


def test_the_protocols_document_names_every_field_and_grpc_method() -> None:
    text = section("protocols.md", "HTTP and WebSocket")
    assert [name for name in REQUEST_FIELDS if f'"{name}"' not in text] == []
    assert [name for name in (*oip_grpc.METHODS, "ModelInfer", "ModelStreamInfer") if f"`{name}`" not in text] == []
