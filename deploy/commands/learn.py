"""The command `rlservo learn`; the work is in deploy/learning."""

from __future__ import annotations

import logging
import re
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.policy import LOCAL, KeyFile
from rlservo.deploy.commands.promote import LONGEST_S, PERCENT, SECONDS, parse_number
from rlservo.errors import UnavailableError, UsageError
from rlservo.extras import needs_extra, require


def learn(
    checkpoint: Annotated[
        Path, typer.Argument(help="Complete checkpoint of RLlib's PPO, APPO or SAC, not a pruned one.")
    ],
    policy: Annotated[str, typer.Option(help="Served policy to train.")],
    repository: Annotated[
        str, typer.Option(metavar="DIR|URI", help="The server's repository, where versions are published.")
    ],
    out: Annotated[Path, typer.Option(help="The run's folder; the same command resumes the run.")],
    recordings: Annotated[
        list[Path], typer.Option(help="Folder in which a server records; repeat the option for each server.")
    ] = [],  # noqa: B006 - typer copies it
    follow: Annotated[
        list[str], typer.Option(metavar="URL", help="Remote server that records; its files are copied to OUT.")
    ] = [],  # noqa: B006
    server: Annotated[str, typer.Option(help="URL of the server.", envvar="RLSERVO_URL")] = LOCAL,
    alias: Annotated[str, typer.Option(help="Alias of the newest version.")] = "learning",
    every: Annotated[int, typer.Option(min=1, help="Updates between two versions, 1 or more.")] = 5,
    batch_size: Annotated[
        int | None, typer.Option(min=1, help="Steps per update, in whole episodes; the checkpoint's by default.")
    ] = None,
    max_age: Annotated[
        int | None,
        typer.Option(min=0, help="Largest age of the acting version, in versions; by default PPO 1, APPO 3, SAC 10."),
    ] = None,
    reward: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="Python file with reward(obs, action, next_obs), in place of the contract's or the clients' rewards.",
        ),
    ] = None,
    reward_from: Annotated[
        list[str],
        typer.Option(metavar="MODULE", help="Module whose functions the contract may name as reward; repeatable."),
    ] = [],  # noqa: B006
    versions: Annotated[
        int | None, typer.Option(min=1, help="Stop after this many new versions; by default at Ctrl-C.")
    ] = None,
    promote: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Watch each version as a canary for this time (10m), then promote it."),
    ] = None,
    canary: Annotated[
        str, typer.Option(metavar="SHARE", help="With --promote: share of the sessions that the canary gets.")
    ] = "20%",
    max_success_drop: Annotated[
        str, typer.Option(metavar="SHARE", help="With --promote: allowed drop in successful episodes.")
    ] = "5%",
    max_error_rate: Annotated[
        str, typer.Option(metavar="SHARE", help="With --promote: share of the version's requests that may fail.")
    ] = "1%",
    app_dir: Annotated[Path, typer.Option(help="Folder of the Python modules that the checkpoint refers to.")] = Path(),
    key_file: KeyFile = None,
) -> None:
    """Train a served policy on the robots that use it.

    Robots use `policy` under the alias and explore; the server records them. Their whole episodes train the
    checkpoint's algorithm. Every few updates the result is exported, proven and published, the server loads it and the
    alias moves to it: robots get it with their next episode. A version that the gate refuses reaches no robot. With
    --promote, robots use `production`, and a version gets there through its canary.

    Example: `rlservo learn checkpoint --policy ur5 --repository policies --recordings recorded --out runs/ur5`
    """
    require("train", "torch", "onnx")
    with needs_extra("client"):
        from rlservo.client.admin_client import AdminClient, find_key
        from rlservo.client.promotion import Terms
        from rlservo.client.promotion_evidence import PromotionLimits
    with needs_extra("record"):
        from rlservo.deploy.learning.followed_recordings import FollowedRecordings, ServerRecordings
    from rlservo.deploy.learning.run_folder import RunFolder

    for url in {server, *follow}:
        find_key(url, key_file)  # a missing key is detected before anything is loaded
    if not recordings and not follow:
        raise UsageError("nothing to learn from: give --recordings FOLDER, or --follow URL of a recording server")
    source = None if reward is None else reward.read_text()
    terms = {"checkpoint": str(checkpoint.absolute()), "policy": policy, "repository": repository}

    def connect(url: str) -> AdminClient:
        try:
            return AdminClient.of_operator(url, key_file)
        except UsageError as error:  # a server removes its key when it ends, and writes a new one when it restarts
            raise UnavailableError(error.message) from None

    with (
        terminal.ends_like_ctrl_c(),
        RunFolder(out, terms, source) as run,
        terminal.status("restoring the checkpoint (importing torch and RLlib takes seconds)") as show,
    ):
        from rlservo.deploy.learning.episode_filter import EpisodeFilter, reward_of
        from rlservo.deploy.learning.online import OnlineLearning, why_interrupted
        from rlservo.deploy.learning.release import Release, Target
        from rlservo.deploy.learning.rllib_learner import OnlineLearner
        from rlservo.export.checkpoints.unpickle import user_code

        if promote is None:
            watched = None
        else:
            rate = parse_number("--max-error-rate", max_error_rate, PERCENT, 1.0)
            drop = parse_number("--max-success-drop", max_success_drop, PERCENT, 1.0)
            share = parse_number("--canary", canary, {**PERCENT, "": 1.0}, 1.0)
            seconds = parse_number("--promote", promote, SECONDS, LONGEST_S)
            if not share or not seconds:
                raise UsageError(f"--promote {promote}, --canary {canary}: expected both above 0")
            watched = Terms((server,), policy, "", share, seconds, PromotionLimits(error_rate=rate, success_drop=drop))
        copies = [
            ServerRecordings(partial(connect, url), run.path / "followed" / re.sub(r"[^A-Za-z0-9.]+", "_", url))
            for url in follow
        ]
        followed = FollowedRecordings(recordings, terminal.note, copies, show)
        logging.getLogger("ray").setLevel(logging.ERROR)  # of deprecated functions that RLlib itself uses
        try:
            with user_code(app_dir):
                learner = OnlineLearner(checkpoint, batch_size=batch_size)
                target = Target(policy, repository, alias, watched)
                release = Release(target, run, partial(connect, server), app_dir=app_dir, progress=show)
                function = release.named_reward(reward_from) if source is None else reward_of(source, str(reward))
                age = learner.max_age if max_age is None else max_age
                admission = EpisodeFilter(policy, max_age=age, reward=function)
                learning = OnlineLearning(
                    learner, run, followed, admission, release, every=every, say=_say, progress=show
                )
                learning.run(versions)
        except KeyboardInterrupt:
            terminal.note(why_interrupted(run))
            raise typer.Exit(130) from None


def _say(line: str) -> None:
    terminal.output().print(line, markup=False, highlight=False, soft_wrap=True)
