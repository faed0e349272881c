"""Run a script's `main` with many command lines in one process: imports take longer than what is tested.

    python run_many.py simple_trainer < [["--run", "A3C"], ...]   prints [{"code", "out", "err"}, ...]

Only for command lines that end before Ray is started.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import sys
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
sys.path.insert(0, str(EXAMPLES))


def main(name: str) -> None:
    script = importlib.import_module(name)
    from shared.training_run import main_with_sentences

    done = []
    for arguments in json.load(sys.stdin):
        sys.argv = [str(EXAMPLES / f"{name}.py"), *arguments]
        out, err, code = io.StringIO(), io.StringIO(), 0
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main_with_sentences(script.main, sys.argv[0])
            except SystemExit as end:
                code = int(end.code or 0) if not isinstance(end.code, str) else 1
        done.append({"code": code, "out": out.getvalue(), "err": err.getvalue()})
    print(json.dumps(done))


if __name__ == "__main__":
    main(sys.argv[1])
