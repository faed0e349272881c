"""MkDocs hooks: the order of the navigation, and every public name on its page."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority

import rlservo

SECTIONS = {"tutorial": "Tutorial", "how-to": "How-to", "reference": "Reference", "explanation": "Explanation"}
PYTHON_PAGE = "reference/python.md"
NOT_OBJECTS = {"__version__", "errors"}  # errors has a page of its own
ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("envs", "export", "serve_app", "deploy")
PACKAGE = tempfile.TemporaryDirectory(prefix="rlservo-site-")  # removed with the process


@event_priority(100)  # before mkdocstrings reads it
def on_config(config: Any) -> Any:
    """Show mkdocstrings the folders under the names they are imported by."""
    package = Path(PACKAGE.name, "rlservo")
    package.mkdir(exist_ok=True)
    for folder in FOLDERS:
        (package / folder).symlink_to(ROOT / folder)
    (package / "__init__.py").symlink_to(ROOT / "deploy" / "package" / "__init__.py")
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [PACKAGE.name]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Give every page a place: those beside the home page first, then the sections."""
    pages = sorted(file.src_uri for file in files.documentation_pages())
    top = [page for page in pages if "/" not in page and page != "index.md"]
    config.nav = [{"Home": "index.md"}, *top]
    for folder, title in SECTIONS.items():
        config.nav.append({title: [page for page in pages if page.startswith(f"{folder}/")]})
    text = Path(config.docs_dir, PYTHON_PAGE).read_text(encoding="utf-8")
    missing = [name for name in rlservo.__all__ if name not in NOT_OBJECTS and f"::: rlservo.{name}\n" not in text]
    if missing:
        raise PluginError(f"{PYTHON_PAGE} does not document {', '.join(missing)}")
    return files
