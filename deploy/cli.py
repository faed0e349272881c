"""The command line `rlservo`: registers the commands and maps errors to exit codes.

Heavy libraries are imported by the command that needs them, so that `rlservo inspect` works on a robot without Ray.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from typing import Annotated

import typer

import rlservo
from rlservo.deploy import terminal
from rlservo.deploy.commands.cockpit import cockpit
from rlservo.deploy.commands.compile import compile
from rlservo.deploy.commands.demo import demo
from rlservo.deploy.commands.export import export, prune
from rlservo.deploy.commands.inspect import inspect
from rlservo.deploy.commands.key import key
from rlservo.deploy.commands.learn import learn
from rlservo.deploy.commands.log import log
from rlservo.deploy.commands.page import page
from rlservo.deploy.commands.policy import policy
from rlservo.deploy.commands.promote import promote
from rlservo.deploy.commands.publish import publish
from rlservo.deploy.commands.replay import estimate, replay
from rlservo.deploy.commands.robot_check import robot_check
from rlservo.deploy.commands.robot_server import robot_latency, robot_server, server_manager, ur_controller
from rlservo.deploy.commands.rollout import rollout
from rlservo.deploy.commands.ros2 import ros2, ros2_sim
from rlservo.deploy.commands.serve import serve
from rlservo.deploy.commands.sign import sign
from rlservo.deploy.commands.verify import verify
from rlservo.errors import RlservoError, UsageError

app = typer.Typer(
    name="rlservo",
    help="Policies from Ray RLlib and other trainers to robots: export, prove, serve, drive.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich's tables and its Markdown parser would double the time of `--help`
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line: exit code 0 only on success, one sentence and no traceback on an error."""
    # By Python's own threshold a collection comes every 700 new objects and walks all that torch and RLlib have made:
    # an eighth of the time of an export.
    gc.set_threshold(100_000, 20, 20)
    # And as Python ends, collections walk all of it again to free what ends with the process: half a second.
    atexit.register(gc.freeze)
    try:
        app()
    except RlservoError as error:
        terminal.errors().print(f"rlservo: {error.message}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(2 if isinstance(error, UsageError) else 1) from None
    except BrokenPipeError:  # the reader of our output went away, as in `rlservo inspect ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        terminal.errors().print(f"rlservo: {what}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None


@app.callback(invoke_without_command=True)
def _root(show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if show_version:
        print(f"rlservo {rlservo.__version__}")
        raise typer.Exit


for command in (
    export,
    prune,
    inspect,
    verify,
    compile,
    page,
    sign,
    publish,
    learn,
    serve,
    key,
    rollout,
    demo,
    cockpit,
    server_manager,
    ur_controller,
    robot_check,
    robot_latency,
    ros2_sim,
    replay,
    estimate,
):
    app.command()(command)
# ROS's own arguments (--ros-args and what follows) are not options of this command.
app.command(context_settings={"ignore_unknown_options": True})(ros2)
policy.command()(promote)
app.add_typer(robot_server, name="robot-server")
app.add_typer(policy, name="policy")
app.add_typer(log, name="log")


if __name__ == "__main__":
    main()
