"""MkDocs hooks: the navigation, README's table on the first page, the HTTP API's page, every public name on a page."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError

import rlservo
from rlservo.serve_app.protocols.asgi_app import create_app
from rlservo.serve_app.protocols.openapi import openapi
from rlservo.serve_app.protocols.pages import files_of_swagger_ui
from rlservo.serve_app.server.settings import ServerSettings

GUIDES = {  # MkDocs warns of a page that is in none
    "Train and export": "your-own-environment train export sources compile",
    "Serve": "serve recurrent-policies versions ray-and-kubernetes",
    "Drive": "control-loop cockpit disturb robo-gym ros2 ur-arm",
    "Operate": "operate secure compose-and-tls object-storage",
    "Learn": "record-and-replay learn learn-online",
}
README = Path(__file__).parents[1] / "README.md"
TABLE = "<!-- README's table -->"  # on the first page
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


def on_files(files: Any, config: Any) -> Any:
    """Give every page a place: the guides by what they are for, the others by their folder."""
    pages = sorted(file.src_uri for file in files.documentation_pages())
    config.nav = [{"Home": "index.md"}, {"Tutorial": "tutorial/first-robot.md"}]
    config.nav += [{title: [f"how-to/{name}.md" for name in names.split()]} for title, names in GUIDES.items()]
    for title in ("Reference", "Explanation"):
        config.nav.append({title: [page for page in pages if page.startswith(f"{title.lower()}/")]})
    text = Path(config.docs_dir, PYTHON_PAGE).read_text(encoding="utf-8")
    missing = [name for name in rlservo.__all__ if name not in NOT_OBJECTS and f"::: rlservo.{name}\n" not in text]
    if missing:
        raise PluginError(f"{PYTHON_PAGE} does not document {', '.join(missing)}")
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put README's table of tasks on the first page, with links from there."""
    if page.file.src_uri != "index.md":
        return markdown
    table = README.read_text(encoding="utf-8").partition("## I want to ...\n\n")[2].partition("\n\n")[0]
    table = re.sub(r"\[([^]]+)\]\((?!docs/)[^)]+\)", r"\1", table).replace("](docs/", "](")  # the others are not here
    if markdown.count(TABLE) != 1 or not table.startswith("|"):
        raise PluginError("index.md has no place for README's table, or README no table")
    return markdown.replace(TABLE, table)


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
