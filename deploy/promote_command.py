"""The command `rlservo policy promote`: a canary that decides; the work is in serve_app/client/promotion.py."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.policy_commands import LOCAL, KeyFile, Name, Url
from rlservo.deploy.terminal import Json, needs_extra, print_json
from rlservo.export.contract.errors import RlservoError, UsageError

SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
LONGEST_S = 30 * 86400.0


def promote(
    name: Name,
    version: Annotated[str, typer.Argument(help="A loaded version, not in production yet.")],
    unless: Annotated[
        str,
        typer.Option(
            help="What speaks against it, joined by 'or': error_rate and success_drop in %, latency_p50 to "
            "latency_p999 in ms, action_difference (mean) or action_difference_p99 in the action's units."
        ),
    ],
    canary: Annotated[str, typer.Option(metavar="SHARE", help="Of the sessions: 10%, or 0.1.")] = "10%",
    seconds: Annotated[str, typer.Option("--for", metavar="TIME", help="How long it is watched: 90s, 10m, 2h.")] = (
        "10m"
    ),
    min_requests: Annotated[
        int, typer.Option(min=1, help="With fewer requests to the version (or compared actions) it is not judged.")
    ] = 100,
    min_episodes: Annotated[
        int, typer.Option(min=1, help="With fewer episodes of either version success_drop is not judged.")
    ] = 20,
    log: Annotated[
        Path | None, typer.Option(help="JSON lines, a check each; promote-NAME-VERSION.jsonl here by default.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Watch what is there, change nothing, say what it would do.")
    ] = False,
    every: Annotated[float, typer.Option(min=0.2, max=10, help="[s] Between checks.")] = 5.0,
    url: Url = LOCAL,
    key_file: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Watch a canary, then promote it or roll it back.

    A share of the sessions gets the version; what all replicas count of it decides whether it is put into production.
    Rolled back at once when a condition is surely met; at the end, when it is met at all. Exit code: 0 promoted, 1
    rolled back, 3 too little to judge, 4 stopped because somebody else has changed what is served or the server is out
    of reach, 2 bad input. Ctrl-C rolls back (130). Killed, it leaves the canary running; the same line, started again,
    goes on with the time that is left.

    Example: `rlservo policy promote ur5 2 --canary 10% --for 10m --unless 'error_rate>0.1% or latency_p99>20ms'`
    """
    from rlservo.export.contract.contract import NAME_PATTERN, VERSION_PATTERN

    with needs_extra("client"):
        from rlservo.serve_app.client.admin_client import AdminClient, find_key
        from rlservo.serve_app.client.promotion import EXIT_CODES, Promotion, Terms
        from rlservo.serve_app.client.promotion_conditions import parse_conditions
        from rlservo.serve_app.client.promotion_log import PromotionLog

    for text, pattern, what in ((name, NAME_PATTERN, "policy name"), (version, VERSION_PATTERN, "version")):
        if re.fullmatch(pattern, text) is None:  # both become part of a file's name
            raise UsageError(f"{text[:80]!r} is no {what}")
    conditions = parse_conditions(unless)
    terms = Terms(
        url, name, version, _share(canary), _seconds(seconds), unless, min_requests, min_episodes, dry_run=dry_run
    )
    file = log or Path(f"promote-{name}-{version}{'-dry-run' if dry_run else ''}.jsonl")

    def connect() -> AdminClient:
        return AdminClient(url, api_key=find_key(url, key_file))

    with PromotionLog.open(file) as opened, _signals():
        promotion = Promotion(connect, terms, conditions, opened, every_s=every, say=terminal.note)
        try:
            outcome = promotion.run()
        except UsageError:
            raise
        except RlservoError as error:  # nothing has begun, and 1 would say that it was rolled back
            raise UsageError(error.message) from None
        except (SystemExit, KeyboardInterrupt) as ended:
            terminal.note(f"ended by a signal: what runs is left as it is; the same line goes on ({file})")
            raise typer.Exit(ended.code if isinstance(ended, SystemExit) else 130) from None  # type: ignore[arg-type]
        finally:
            promotion.close()
    if as_json:
        print_json({"outcome": outcome.outcome, "why": outcome.why, "finished": outcome.is_finished, "log": str(file)})
    else:
        verb = f"would be {outcome.outcome}" if dry_run else outcome.outcome
        sentence = f"{verb}: version {version} of '{name}': {outcome.why}"
        terminal.output().print(sentence, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(EXIT_CODES[outcome.outcome])


@contextmanager
def _signals() -> Iterator[None]:
    """Ctrl-C interrupts, also in a shell's background job; SIGTERM and a closed terminal end without a decision."""

    def end(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    with terminal.ends_like_ctrl_c():
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, end)
        yield


def _share(text: str) -> float:
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(%?)", text.strip())
    share = float(match[1]) / (100 if match[2] else 1) if match else 0.0
    if not 0 < share <= 1:
        raise UsageError(f"--canary {text[:40]!r}: expected a share above 0 and at most 1, such as 10% or 0.1")
    return share


def _seconds(text: str) -> float:
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([smhd])", text.strip())
    seconds = float(match[1]) * SECONDS[match[2]] if match else 0.0
    if not 0 < seconds <= LONGEST_S:
        raise UsageError(f"--for {text[:40]!r}: expected a time such as 90s, 10m or 2h, at most 30d")
    return seconds
