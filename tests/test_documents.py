"""Documents keep to the width of the code."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

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
