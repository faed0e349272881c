"""Run of the cockpit: open the sources, serve the page, draw until Ctrl-C."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import viser

from rlservo.deploy.cockpit.drive import Drive
from rlservo.deploy.cockpit.page import HOST, Shown, served_page, show
from rlservo.deploy.cockpit.panel import DrivePanel
from rlservo.deploy.cockpit.playback import PlaybackPanel, Tape
from rlservo.deploy.cockpit.policies import Choice, PolicySource
from rlservo.deploy.cockpit.watch import WatchPanel
from rlservo.deploy.terminal import ctrl_c_sets
from rlservo.errors import UnknownPolicyError, UsageError
from rlservo.policy.acting_policy import PRODUCTION
from rlservo.recording.recorder import Recorder

OnReady = Callable[[str], None]


def run_drive(
    source: PolicySource,
    *,
    policy: str | None,
    version: str | None,
    env_id: str | None,
    env_arguments: Mapping[str, Any],
    port: int,
    seed: int | None,
    record: Path | None = None,
    unproven: bool = False,
    on_ready: OnReady,
) -> None:
    """Let a policy drive a robot on a page until Ctrl-C. Everything that was opened is closed."""
    with ExitStack() as cleanup:
        cleanup.callback(source.close)
        choice = first_choice(source, policy, version)
        recorder = None if record is None else cleanup.enter_context(Recorder(record))
        drive = Drive(
            source, choice, env_id=env_id, env_arguments=env_arguments, seed=seed, recorder=recorder, unproven=unproven
        )
        cleanup.callback(drive.close)
        server = cleanup.enter_context(served_page(port, "rlservo cockpit"))
        panel = DrivePanel(server, drive, source)
        cleanup.callback(panel.close)
        drive.start()
        _serve(server, panel, on_ready)


def run_playback(
    recording: Path,
    *,
    bundle: Path | None,
    policy: str | None,
    env_id: str | None,
    port: int,
    on_ready: OnReady,
) -> None:
    """Show a recording on a page until Ctrl-C."""
    tape = Tape(recording, bundle=bundle, policy=policy)
    with ExitStack() as cleanup:
        server = cleanup.enter_context(served_page(port, f"rlservo cockpit: {recording.name}"))
        panel = PlaybackPanel(server, tape, env_id=env_id)
        cleanup.callback(panel.close)
        _serve(server, panel, on_ready)


def run_watch(
    address: str,
    *,
    env_arguments: Mapping[str, Any],
    port: int,
    on_ready: OnReady,
) -> None:
    """Show a robot server's simulation until Ctrl-C."""
    with ExitStack() as cleanup:
        server = cleanup.enter_context(served_page(port, f"rlservo cockpit: {address}"))
        panel = WatchPanel(server, address, env_arguments)
        cleanup.callback(panel.close)
        _serve(server, panel, on_ready)


def _serve(server: viser.ViserServer, panel: Shown, on_ready: OnReady) -> None:
    stop = threading.Event()
    with ctrl_c_sets(stop):
        on_ready(f"http://{HOST}:{server.get_port()}")
        show(panel, stop)


def first_choice(source: PolicySource, policy: str | None, version: str | None) -> Choice:
    """Return the initial choice: the default version of the policy, or of the first one."""
    versions = source.versions()
    if not versions:
        raise UnknownPolicyError("the server has no policy loaded")
    if policy is not None and policy not in versions:
        raise UsageError(f"there is no policy {policy!r}: expected one of {', '.join(versions)}")
    name = policy or next(iter(versions))
    default = PRODUCTION if PRODUCTION in versions[name] else versions[name][0]
    if version is not None and version not in versions[name]:
        raise UsageError(f"policy {name!r} has no version {version!r}: expected one of {', '.join(versions[name])}")
    return Choice(name, version or default)
