"""The page: viser's server on loopback, and a loop that draws thirty times a second until it is stopped."""

from __future__ import annotations

import contextlib
import errno
import functools
import gzip
import html
import io
import re
import socket
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol

import numpy as np
import viser
import websockets.asyncio.server

from rlservo.deploy.cockpit.message_checks import checked_messages, point_of
from rlservo.deploy.cockpit.stage import Vector
from rlservo.errors import UsageError

HOST = "127.0.0.1"
FRAME_S = 1 / 30
NEARER = 0.62  # tan(45 / 2) / tan(75 / 2), about: MuJoCo's angle of view to viser's
NARROW = 0.75  # of a window's width to its height, below which it is a phone's
FARTHER, SHEET = 1.7, 0.6  # the same for a phone's camera: distance, and height of the middle above the window's
PANEL_S = 0.5  # between two refreshes of numbers and plots: drawn in software, one costs as much as a frame
HOSTS = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")  # of any port: one may be forwarded to ours
# viser's page is one file, which unpacks itself and compiles a part of its scripts from strings.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; "
    "worker-src blob:; style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
    "connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


_phones: weakref.WeakSet[viser.ClientHandle] = weakref.WeakSet()


class Shown(Protocol):
    """Content of a page."""

    def draw(self) -> None:
        """Draw a frame of the scene."""
        ...

    def refresh(self, frames_per_s: float) -> None:
        """Refresh numbers and plots."""
        ...


class _PageServer(viser.ViserServer):
    """viser's server without its tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Refuse: a page can request it, with or without the button."""
        return None


@contextlib.contextmanager
def served_page(port: int, title: str) -> Iterator[viser.ViserServer]:
    """Serve an empty page until the block ends. Raises UsageError if the port is taken."""
    _check_port(port)
    with _silence(), _guarded_requests(title):  # its own banner names a port that ours names as well
        server = _PageServer(HOST, port, label=title, verbose=False)
    try:
        with checked_messages():
            server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=False)
            # Shadows and reflections take five times as long to draw if there is no graphics card.
            server.scene.configure_default_lights(cast_shadow=False)
            server.scene.configure_environment_map(None)
            server.scene.add_light_hemisphere("/sky", ground_color=(190, 190, 190), intensity=1.5)
            server.gui.main_panel.dock_right()
            server.on_client_connect(partial(_keep_aimed, server.initial_camera))
            yield server
    finally:
        with _silence():
            server.stop()


def show(shown: Shown, stop: threading.Event) -> None:
    """Draw until `stop`. A frame that is late is left out."""
    frames: deque[float] = deque(maxlen=60)
    due = refresh_at = time.perf_counter()
    while not stop.is_set():
        time.sleep(max(0.0, due - time.perf_counter()))  # not `stop.wait`: a handler of this thread may set it
        now = time.perf_counter()
        due = max(due + FRAME_S, now)
        shown.draw()
        frames.append(now)
        if now >= refresh_at:
            refresh_at = now + PANEL_S
            span_s = now - frames[0]
            shown.refresh((len(frames) - 1) / span_s if span_s > 0 else 0.0)


def set_value(handle: Any, value: Any) -> None:
    """Set the value of a choice or a slider. (mypy does not see viser's setter.)"""
    if handle.value != value:
        handle.value = value


def aim_cameras(server: viser.ViserServer, position: Vector, look_at: Vector) -> None:
    """Place the camera of every present and future browser, closer for a wider lens."""
    position = look_at + NEARER * (position - look_at)
    server.initial_camera.position, server.initial_camera.look_at = position, look_at
    for client in server.get_clients().values():
        _aim(client.camera, position, look_at)


def _keep_aimed(initial: Any, client: viser.ClientHandle) -> None:
    """Aim a new client's camera, a phone's also when the page, later, puts it where a desktop's begins."""

    def aim_again(camera: viser.CameraHandle) -> None:
        if np.allclose(camera.position, initial.position, atol=1e-3):
            _aim(camera, initial.position, initial.look_at)

    # Decided now: later the panels beside it leave a desktop's scene narrow as well.
    if client.camera.image_width < NARROW * client.camera.image_height:
        _phones.add(client)
        client.camera.on_update(aim_again)
    _aim(client.camera, initial.position, initial.look_at)


def _aim(camera: viser.CameraHandle, position: Vector, look_at: Vector) -> None:
    """Aim a camera; on a phone so that its target is above the sheet with the panels, which covers three fifths."""
    if camera.client in _phones:
        way = FARTHER * (look_at - position)
        ahead = way / np.linalg.norm(way)
        up = np.array([0.0, 0.0, 1.0]) - ahead[2] * ahead
        down = SHEET * np.tan(camera.fov / 2) * np.linalg.norm(way) * up / np.linalg.norm(up)
        position, look_at = look_at - way - down, look_at - down
    if point_of(camera.position) is not None and point_of(camera.look_at) is not None:  # viser fails with others
        with contextlib.suppress(ValueError), np.errstate(all="ignore"):  # the browser sent an impossible one just now
            camera.position, camera.look_at = position, look_at


def _check_port(port: int) -> None:
    """Refuse a port that is taken: viser would quietly take the next one."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
    except OSError as error:
        reason = "the port is taken: give another with --port" if error.errno == errno.EADDRINUSE else error.strerror
        raise UsageError(f"the cockpit cannot listen on {HOST}:{port}: {reason}") from error


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _guarded_requests(title: str) -> Iterator[None]:
    """Let only the cockpit's own page, and programs, talk to it, and no other page embed it: viser has no such option.

    Any other web page in the same browser could drive the robot. The tab of the page has this title.
    """
    server: Any = websockets.asyncio.server
    serve = server.serve

    def guarded(*given: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            refusal = _refusal(request.headers)
            reply = connection.respond(403, f"{refusal}\n") if refusal else process_request(connection, request)
            if reply is not None:
                reply.headers.update(HEADERS)
                if request.path.partition("?")[0] == "/" and not refusal:
                    reply.body = _titled(reply.body, title)
                    del reply.headers["Content-Length"]
                    reply.headers["Content-Length"] = str(len(reply.body))
            return reply

        return serve(*given, process_request=answer, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


@functools.lru_cache(maxsize=4)
def _titled(page: bytes, title: str) -> bytes:
    """Return viser's page, which may be compressed, with a title of its own."""
    if page.startswith(b"\x1f\x8b"):
        return gzip.compress(_titled(gzip.decompress(page), title))
    return page.replace(b"<title>Viser</title>", f"<title>{html.escape(title)}</title>".encode(), 1)


def _refusal(headers: Any) -> str:
    """Return the reason to refuse a request, or an empty text. Programs send no Origin."""
    host = "".join(headers.get_all("Host")).lower()
    if not HOSTS.fullmatch(host):
        return f"the host {host[:100]!r} is not this machine: the cockpit is at {HOST}"
    origins = headers.get_all("Origin")
    if any(origin.lower() not in (f"http://{host}", f"https://{host}") for origin in origins):
        return f"a page from {', '.join(origins)[:100]} may not use the cockpit"
    return ""
