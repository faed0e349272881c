"""Commands of `rlservo` in one process: python -m rlservo.deploy.demo.commands '[["export", ...], ["export", ...]]'

To import torch and RLlib takes longer than to export a policy: this way it happens once.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence

from rich.console import Console


def main() -> None:
    """Show and run each command; the first that fails ends it, with its exit code."""
    from rlservo.deploy import cli  # here: it imports what imports this module

    console = Console()
    for words in json.loads(sys.argv[1]):
        show(console, words)
        sys.argv = ["rlservo", *words]
        try:
            cli.main()
        except SystemExit as end:
            if end.code:
                raise


def show(console: Console, words: Sequence[str]) -> None:
    """Print a command as a user would type it."""
    console.print(f"$ rlservo {shlex.join(words)}", style="bold", markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
