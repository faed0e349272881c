"""The command `rlservo learn`; the work is in serve_app/learning."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.policy import LOCAL, KeyFile
from rlservo.export.contract.errors import UnavailableError, UsageError
from rlservo.export.contract.extras import needs_extra, require


def learn(
    checkpoint: Annotated[Path, typer.Argument(help="A whole checkpoint of RLlib's PPO (new API stack), not pruned.")],
    policy: Annotated[str, typer.Option(help="The served policy that learns.")],
    repository: Annotated[
        str, typer.Option(metavar="DIR|URI", help="The server's repository; versions are published there.")
    ],
    recordings: Annotated[list[Path], typer.Option(help="Folder in which a server records; one for each server.")],
    out: Annotated[Path, typer.Option(help="The run's folder; the same command resumes from it.")],
    server: Annotated[str, typer.Option(help="URL of the server.", envvar="RLSERVO_URL")] = LOCAL,
    alias: Annotated[str, typer.Option(help="Alias of the newest version.")] = "learning",
    every: Annotated[int, typer.Option(min=1, help="Updates between two versions.")] = 5,
    batch_size: Annotated[
        int | None, typer.Option(min=1, help="Steps of whole episodes per update; the checkpoint's by default.")
    ] = None,
    max_age: Annotated[
        int, typer.Option(min=0, help="Versions by which the one that acted may be behind; older episodes are dropped.")
    ] = 1,
    reward: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="Python file with reward(obs, action, next_obs), instead of the clients' rewards.",
        ),
    ] = None,
    versions: Annotated[
        int | None, typer.Option(min=1, help="Stop after this many new versions; at Ctrl-C by default.")
    ] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of the Python modules that the checkpoint refers to.")] = Path(),
    key_file: KeyFile = None,
) -> None:
    """Train a served policy from the robots that use it.

    Robots ask the server for `policy` under the alias and explore; the server records them. Their whole episodes train
    PPO from the checkpoint on. Every few updates the result is exported, proven and published, the server loads it and
    the alias moves to it: robots get it with their next episode. A version that the gate refuses reaches no robot.

    Example: `rlservo learn checkpoint --policy ur5 --repository policies --recordings recorded --out runs/ur5`
    """
    require("train", "torch", "onnx")
    with needs_extra("client"):
        from rlservo.serve_app.client.admin_client import AdminClient, find_key
    with needs_extra("record"):
        from rlservo.serve_app.learning.following import FollowedRecordings
    from rlservo.serve_app.learning.run_folder import RunFolder

    find_key(server, key_file)  # a missing key is found out before anything is loaded
    followed = FollowedRecordings(recordings, terminal.note)
    source = None if reward is None else reward.read_text()
    terms = {"checkpoint": str(checkpoint.absolute()), "policy": policy, "repository": repository}

    def connect() -> AdminClient:
        try:
            return AdminClient(server, api_key=find_key(server, key_file))
        except UsageError as error:  # a server removes its own key when it ends, and writes one when it starts again
            raise UnavailableError(error.message) from None

    with (
        terminal.ends_like_ctrl_c(),
        RunFolder(out, terms, source) as run,
        terminal.status("restoring the checkpoint (importing torch and RLlib takes seconds)") as show,
    ):
        from rlservo.export.checkpoints.unpickle import user_code
        from rlservo.serve_app.learning.admission import Admission, reward_of
        from rlservo.serve_app.learning.online import OnlineLearning, why_interrupted
        from rlservo.serve_app.learning.release import Release, Target
        from rlservo.serve_app.learning.rllib_learner import OnlineLearner

        logging.getLogger("ray").setLevel(logging.ERROR)  # of deprecated ways that RLlib itself takes
        try:
            with user_code(app_dir):
                learner = OnlineLearner(checkpoint, batch_size=batch_size)
                release = Release(Target(policy, repository, alias), run, connect, app_dir=app_dir, progress=show)
                function = None if source is None else reward_of(source, str(reward))
                admission = Admission(policy, max_age=max_age, reward=function)
                OnlineLearning(
                    learner, run, followed, admission, release,
                    every=every, max_age=max_age, say=_say, progress=show,
                ).run(versions)  # fmt: skip
        except KeyboardInterrupt:
            terminal.note(why_interrupted(run))
            raise typer.Exit(130) from None


def _say(line: str) -> None:
    terminal.output().print(line, markup=False, highlight=False, soft_wrap=True)
