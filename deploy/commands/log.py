"""The commands `rlservo log ...`: show, convert, repair and draw recordings."""

from __future__ import annotations

import shlex
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlservo.deploy import terminal
from rlservo.deploy.terminal import Json, print_json
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    from rlservo.recording.summary import Summary

log = typer.Typer(no_args_is_help=True, help="Show, convert and draw recordings.")

Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings (.mcap), or folders with recordings.")]
PolicyName = Annotated[
    str | None, typer.Option("--policy", help="Name of the recorded policy; required if the recordings hold several.")
]


class Format(str, Enum):
    """Target formats of a recording."""

    parquet = "parquet"
    lerobot = "lerobot"
    minari = "minari"


@log.command()
def info(files: Files, as_json: Json = False) -> None:
    """Show what recordings contain and which records are missing. A folder may also hold ROS 2 bags (.mcap).

    Example: `rlservo log info recordings`
    """
    with needs_extra("record"):
        from rlservo.recording.reader import Recording
        from rlservo.recording.summary import summarise_recording

    summary = summarise_recording(Recording(files, with_bags=True))
    if as_json:
        print_json(summary.as_dict())
    else:
        _print_summary(summary)


@log.command()
def export(
    files: Files,
    to: Annotated[Format, typer.Option("--to", help="Target format.")],
    out: Annotated[Path, typer.Option(help="New file (parquet), or new folder.")],
    policy: PolicyName = None,
    task: Annotated[str | None, typer.Option(help="Description of the robot's task, for LeRobot.")] = None,
) -> None:
    """Convert recordings to Parquet, LeRobotDataset v3.0 or Minari.

    Example: `rlservo log export run.mcap --to parquet --out run.parquet`
    """
    with needs_extra("record"):
        from rlservo.recording.conversion.lerobot import export_lerobot
        from rlservo.recording.conversion.minari import PATH_VARIABLE, export_minari
        from rlservo.recording.conversion.parquet import export_parquet
        from rlservo.recording.reader import Recording

    recording = Recording(files)
    with terminal.writing(out):
        if to is Format.parquet:
            line = f"written {out}: {export_parquet(recording, out, name=policy)} decisions"
        elif to is Format.lerobot:
            episodes, frames = export_lerobot(recording, out, name=policy, task=task)
            line = f"written {out}: {episodes} episodes, {frames} frames"
        else:
            identity, episodes, env = export_minari(recording, out, name=policy)
            made_in = f"of {env}" if env else "without an installed environment"
            place = f"{PATH_VARIABLE}={shlex.quote(str(out.resolve()))}"
            line = f"written {out}: {episodes} episodes {made_in}; {place}, then minari.load_dataset({identity!r})"
    _line(line)


@log.command()
def repair(
    file: Annotated[Path, typer.Argument(metavar="FILE", exists=True, dir_okay=False, help="A recording (.mcap).")],
    out: Annotated[Path, typer.Option(help="New file.")],
) -> None:
    """Copy a recording that was cut off to a complete file.

    The copy ends with the last complete chunk and has the index that other programs need. FILE is not changed.

    Example: `rlservo log repair run.mcap --out whole.mcap`
    """
    with needs_extra("record"):
        from rlservo.recording.repair import repair_recording

    with terminal.writing(out):
        facts = repair_recording(file, out)
    _line(f"written {out}: {facts.messages} messages{f'; {file} is {facts.damage}' if facts.damage else ''}")


@log.command()
def plot(
    files: Files,
    episode: Annotated[
        int,
        typer.Option(min=0, help="Number of the episode, from 0, in the order in which the policy's episodes ended."),
    ] = 0,
    policy: PolicyName = None,
    out: Annotated[Path, typer.Option(help="File for the picture: .png, .svg or .pdf.")] = Path("episode.png"),
) -> None:
    """Draw one recorded episode.

    Observations and actions by name, rewards, latency and warnings.

    Example: `rlservo log plot run.mcap --episode 3 --out episode.png`
    """
    with needs_extra("record"):
        from rlservo.recording.plot import plot_episode
        from rlservo.recording.reader import Recording

    with terminal.writing(out):
        drawn = plot_episode(Recording(files), episode, out, name=policy)
    terminal.output().print(f"written {out}: {len(drawn)} decisions", markup=False, highlight=False, soft_wrap=True)


def _print_summary(summary: Summary) -> None:
    for file in summary.files:
        state = "whole" if file["whole"] else "being written" if file["being_written"] else "without an end"
        notes = [f"{file['messages']} messages", state]
        if file["deleted"]:
            notes = ["deleted before it was read"]
        if file["bag_topics"]:
            notes = [f"a ROS 2 bag, {_bag(file, summary)}", *notes[1:]]
        if file["dropped"]:
            notes.append(f"{file['dropped']} records were dropped")
        if file["clock_jumps"]:
            notes.append(f"the wall clock jumped {file['clock_jumps']} times")
        if file["damage"]:
            notes.append(file["damage"])
        _line(f"{file['path']}: {', '.join(notes)}")
    for policy in summary.policies:
        _line(f"{policy.name} version {policy.version}  graph {policy.graph_sha256[:12] or 'not known'}")
        span = policy.last_s - policy.first_s
        last = f", {policy.seconds:.1f} s long together" if policy.episodes else ""
        decisions = f"{policy.decisions} decisions recorded over {span:.1f} s"
        _line(f"  {policy.episodes} episodes ({policy.ended} ended){last}, {decisions}")
        if policy.endings:
            _line(f"  endings: {', '.join(f'{word}: {count}' for word, count in policy.endings.items())}")
        if policy.return_mean is not None:
            _line(f"  mean return {policy.return_mean:.4g}")
        if policy.latency_p50_ms is not None:
            _line(f"  latency p50 {policy.latency_p50_ms:.3g} ms, p99 {policy.latency_p99_ms:.3g} ms")
        _line(
            f"  explored {policy.explored}, warnings {policy.warnings}, without an action {policy.without_action}, "
            f"fallbacks {policy.fallbacks}, episodes with a gap {policy.gaps}"
        )


def _bag(file: dict[str, Any], summary: Summary) -> str:
    """Describe a bag's content, and the offset of its time from the decisions' time; both count from 1970."""
    topics = ", ".join(f"{topic} {count}" for topic, count in sorted(file["bag_topics"].items()))
    first_s = min((policy.first_s for policy in summary.policies), default=None)
    begins = "" if first_s is None else f", from {file['bag_first_s'] - first_s:+.1f} s of the first decision"
    return f"{file['messages']} messages over {file['bag_last_s'] - file['bag_first_s']:.1f} s{begins} ({topics})"


def _line(text: str) -> None:
    terminal.output().print(text, markup=False, highlight=False, soft_wrap=True)
