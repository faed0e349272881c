"""Commands of `rlservo` in one process: python -m rlservo.deploy.demo.one_process '[["export", ...], ["export", ...]]'

To import torch and RLlib takes longer than to export a policy: this way it happens once.
"""

from __future__ import annotations

import json
import sys

from rlservo.deploy import cli
from rlservo.deploy.terminal import show_command


def main() -> None:
    """Show and run each command; the first that fails ends it, with its exit code."""
    for words in json.loads(sys.argv[1]):
        show_command(words)
        sys.argv = ["rlservo", *words]
        try:
            cli.main()
        except SystemExit as end:
            if end.code:
                raise


if __name__ == "__main__":
    main()
