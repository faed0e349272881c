"""Wrapper that Ray runs as the HAProxy binary: patches its configuration, then becomes HAProxy, with a watcher beside.

Ray (2.60) starts HAProxy from an actor, anew for every change of replicas (`haproxy.py` there). `installation.py`
writes the script that runs this file: `python -IS wrapper.py FOLDER BINARY`, and HAProxy's own arguments.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import NoReturn


def main(folder: str, binary: str, *arguments: str) -> NoReturn:
    """Become HAProxy. `folder` has its own replies."""
    from rlservo.serve_app.ray_serve.haproxy import configuration, error_replies, listening_sockets, watcher

    if "-f" in arguments:
        file = Path(arguments[arguments.index("-f") + 1])
        known = file.with_name(watcher.KNOWN)
        error_replies.write_error_replies(Path(folder))  # it may have been installed by an earlier version
        text = file.read_text()
        try:
            addresses = configuration.listening_addresses(text)
            text = configuration.patch_configuration(text, Path(folder))
            addresses, were_kept = listening_sockets.inherit_or_open(file.parent, addresses)
            text = configuration.inherit_sockets(text, addresses)
        except configuration.TemplateError as error:
            sys.exit(str(error))
        if configuration.knows_replicas(text):
            known.write_text(text)
        elif were_kept and "-sf" not in arguments and known.exists():
            # The first HAProxy of an actor that replaces another one, and knows no replica yet.
            text = known.read_text()
        else:
            known.unlink(missing_ok=True)
        file.write_text(text)
        watcher.leave_watcher(binary, file, addresses)
    os.execv(binary, [binary, *arguments])


def _make_package() -> None:
    """Make `rlservo` importable without site-packages: the folders beside this file's, in a checkout or installed."""
    package = ModuleType("rlservo")
    package.__path__ = [str(Path(__file__).resolve().parents[3])]
    sys.modules["rlservo"] = package


if __name__ == "__main__":
    _make_package()
    main(*sys.argv[1:])
