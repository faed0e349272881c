"""The command `rlservo policy promote`; the work is in rlservo/client/promotion.py."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.policy import LOCAL, KeyFile, Name
from rlservo.deploy.terminal import Json, print_json
from rlservo.errors import RlservoError, UsageError
from rlservo.extras import needs_extra

PERCENT = {"%": 0.01}
SECONDS = {"ms": 1e-3, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
LONGEST_S = 30 * 86400.0


def promote(
    name: Name,
    version: Annotated[str, typer.Argument(help="A loaded version that is not in production.")],
    canary: Annotated[str, typer.Option(metavar="SHARE", help="Share of the sessions: 10%, or 0.1.")] = "10%",
    seconds: Annotated[
        str, typer.Option("--for", metavar="TIME", help="How long to watch the canary: 90s, 10m, 2h.")
    ] = "10m",
    max_error_rate: Annotated[
        str | None,
        typer.Option(metavar="SHARE", help="Share of the version's requests that may fail through its fault: 0.1%."),
    ] = None,
    max_p99: Annotated[
        str | None, typer.Option(metavar="TIME", help="Latency in the server that 1% of the answers may exceed: 20ms.")
    ] = None,
    max_action_difference: Annotated[
        float | None,
        typer.Option(min=0, help="Difference from production, in action units, that 1% of the actions may exceed."),
    ] = None,
    max_success_drop: Annotated[
        str | None,
        typer.Option(metavar="SHARE", help="Allowed drop in the share of successful episodes from production's: 2%."),
    ] = None,
    min_requests: Annotated[
        int,
        typer.Option(min=1, help="Requests (or compared actions) required for a decision; never fewer than 1 / limit."),
    ] = 100,
    min_episodes: Annotated[int, typer.Option(min=1, help="Episodes of each version required for a decision.")] = 20,
    log: Annotated[
        Path | None, typer.Option(help="File for the log in JSON lines; promote-NAME-VERSION.jsonl by default.")
    ] = None,
    every: Annotated[float, typer.Option(min=1, max=10, help="Seconds between checks, 1 to 10.")] = 5.0,
    url: Annotated[
        list[str],
        typer.Option(
            help="URL of the server; repeat it to read the metrics of several replicas.", envvar="RLSERVO_URL"
        ),
    ] = [LOCAL],  # noqa: B006 - typer copies it
    key_file: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Watch a canary, then promote it or roll it back.

    A share of the sessions gets the version, and the servers' metrics decide. It is rolled back at once if a limit is
    exceeded with 99.7% confidence, if metrics fall or contradict themselves, or if they cannot be read for a minute;
    and at the end if a limit is exceeded or there were too few cases. Exit code: 0 promoted, 1 rolled back, 4 stopped
    because another command changed what is served or the server is unreachable, 2 bad input. Ctrl-C rolls back (130).
    If the command is killed, the canary keeps running; the same command continues with the remaining time.

    Example: `rlservo policy promote ur5 2 --canary 10% --for 10m --max-error-rate 0.1% --max-p99 20ms`
    """
    from rlservo.bundle.contract import NAME_PATTERN, VERSION_PATTERN

    with needs_extra("client"):
        from rlservo.client.admin_client import AdminClient
        from rlservo.client.promotion import EXIT_CODES, Promotion, Terms
        from rlservo.client.promotion_evidence import PromotionLimits
        from rlservo.client.promotion_log import PromotionLog

    for text, pattern, what in ((name, NAME_PATTERN, "policy name"), (version, VERSION_PATTERN, "version")):
        if re.fullmatch(pattern, text) is None:  # both become part of a file's name
            raise UsageError(f"{text[:80]!r} is not a {what}")
    limits = PromotionLimits(
        error_rate=parse_number("--max-error-rate", max_error_rate, PERCENT, 1.0),
        p99_s=parse_number("--max-p99", max_p99, SECONDS, 1.0),
        action_difference=max_action_difference,
        success_drop=parse_number("--max-success-drop", max_success_drop, PERCENT, 1.0),
        min_requests=min_requests,
        min_episodes=min_episodes,
    )
    if limits == PromotionLimits(min_requests=min_requests, min_episodes=min_episodes):
        raise UsageError(
            "no limit was given: give --max-error-rate, --max-p99, --max-action-difference or --max-success-drop"
        )
    share = parse_number("--canary", canary, {**PERCENT, "": 1.0}, 1.0)
    watched_s = parse_number("--for", seconds, SECONDS, LONGEST_S)
    if not share or not watched_s:
        raise UsageError(f"--canary {canary}, --for {seconds}: expected both above 0")
    terms = Terms(tuple(url), name, version, share, watched_s, limits)
    file = log or Path(f"promote-{name}-{version}.jsonl")

    def connect(url: str) -> AdminClient:
        return AdminClient.of_operator(url, key_file)

    with PromotionLog.open(file) as opened, _signals():
        try:
            outcome = Promotion(connect, terms, opened, every_s=every, say=terminal.note).run()
        except UsageError:
            raise
        except RlservoError as error:  # nothing has begun, and 1 would mean that it was rolled back
            raise UsageError(error.message) from None
        except (SystemExit, KeyboardInterrupt) as ended:
            left = f"the canary keeps running; the same command continues ({file})"
            terminal.note(f"stopped by a signal: {left if opened.has_begun else 'nothing was changed'}")
            raise typer.Exit(ended.code if isinstance(ended, SystemExit) else 130) from None  # type: ignore[arg-type]
    if as_json:
        print_json({"outcome": outcome.outcome, "why": outcome.why, "finished": outcome.is_finished, "log": str(file)})
    else:
        sentence = f"{outcome.outcome}: version {version} of '{name}': {outcome.why}"
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


def parse_number(option: str, text: str | None, units: dict[str, float], largest: float) -> float | None:
    """Return the number that an option gives with its unit. Raises UsageError."""
    if text is None:
        return None
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([a-z%]*)", text.strip())
    number = float(match[1]) * units[match[2]] if match and match[2] in units else -1.0
    if not 0 <= number <= largest:
        example, most = ("0.1%", "100%") if "%" in units else ("20ms, 90s, 10m or 2h", f"{largest:g} s")
        raise UsageError(f"{option} {text[:40]!r}: expected a number with its unit, such as {example}, at most {most}")
    return number
