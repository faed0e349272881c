"""Run training scripts one after the other in one process and one Ray, where starting a Ray is not what is tested.

A request is a line on standard input, ["FOLDER", "SCRIPT", "ARGUMENT", ...]: the script runs in the folder, made if it
is new. The reply is a line on standard output: the folder, how it ended, and what it left in the home folder.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import runpy
import sys
import traceback
from pathlib import Path

import quick_rllib  # noqa: F401  # before RLlib

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent / "examples"
OWN_CODE = HERE / "examples" / "app"  # environments of some of the scripts
sys.path[:0] = [str(EXAMPLES), str(HERE)]

import shared.training_run as training_run  # noqa: E402


def main() -> None:
    with training_run.ray_session(num_cpus=1, app_dir=OWN_CODE):
        training_run.ray_session = lambda **_: contextlib.nullcontext()  # the scripts' own
        for line in sys.stdin:
            folder, *words = json.loads(line)
            Path(folder).mkdir(exist_ok=True)
            os.chdir(folder)
            before = in_home()
            code, out, err = run(*words)
            left = list(in_home() - before)
            print(json.dumps({"folder": folder, "code": code, "out": out, "err": err, "home": left}), flush=True)


def in_home() -> set[str]:
    return {path.name for path in Path.home().iterdir()}


def run(script: str, *arguments: str) -> tuple[int, str, str]:
    sys.argv = [str(EXAMPLES / script), *arguments]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_path(sys.argv[0], run_name="__main__")
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception:
            code = 1
            traceback.print_exc()
    return code, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    main()
