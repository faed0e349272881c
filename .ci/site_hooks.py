"""MkDocs hooks: the order of the navigation, the page of the HTTP API, and every public name on its page."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority

import rlservo
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.openapi import openapi
from rlservo.serve_app.protocols.pages import files_of_swagger_ui
from rlservo.serve_app.server.settings import ServerSettings

SECTIONS = {"tutorial": "Tutorial", "how-to": "How-to", "reference": "Reference", "explanation": "Explanation"}
PYTHON_PAGE = "reference/python.md"
NOT_OBJECTS = {"__version__", "errors"}  # errors has a page of its own
OPENAPI_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>rlservo API</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">
<link rel="stylesheet" href="swagger/swagger-ui.css"><style>
.message.thrown, .errors small {overflow-wrap: anywhere; white-space: normal}
</style></head>
<body><div id="swagger-ui"></div><script src="swagger/swagger-ui-bundle.js"></script><script>
SwaggerUIBundle({spec: %s, dom_id: "#swagger-ui", validatorUrl: null, supportedSubmitMethods: [],
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout"});
</script></body></html>
"""


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


def on_post_build(config: Any) -> None:
    """Write the page of the HTTP API, with the document inside: a page from disk may fetch nothing."""
    site = Path(config.site_dir)
    (site / "swagger").mkdir(exist_ok=True)
    for name in ("swagger-ui.css", "swagger-ui-bundle.js"):
        shutil.copy(files_of_swagger_ui() / name, site / "swagger" / name)
    control: Any = object()  # nothing is asked of it
    text = openapi(create_app(control, ServerSettings()).table).decode().replace("</", "<\\/")
    # Swagger UI resolves an OpenAPI 3.1 document's references by the page's address, which a page from disk lacks.
    text = text.replace('"openapi":"3.1.0"', '"openapi":"3.0.3"', 1)
    (site / "openapi.html").write_text(OPENAPI_PAGE % text, encoding="utf-8")
