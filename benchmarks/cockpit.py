"""Cockpit speed: frames per second of one robot in a real browser, with the policy server on the same machine.

    python benchmarks/cockpit.py policies [--policy ur5] [--seconds 8] [--window 1280x720 800x600] [--resolution 1 0.5]

`rlservo serve` and `rlservo cockpit --url` run as processes of their own, as users run them, and Chromium without a
window looks at the page (`pip install playwright`; it draws with the graphics card, or in software, and the renderer's
name is printed). For every window and resolution (canvas pixels to a screen's; below 1 is viser's `?fixedDpr=`) it
prints the frames that the page drew, those that the cockpit published (the page shows them), and each part's processor
time per drawn frame; plots, numbers and layout depend on time, not on frames.
"""

from __future__ import annotations

import argparse
import itertools
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from playwright.sync_api import sync_playwright
from rich.console import Console
from rich.table import Table

SETTLE_S = 4.0  # shaders are compiled, viser has settled on a resolution
PATIENCE_S = 120.0
# Draws are counted at WebGL's calls: a frame without a draw does not count.
COUNTER = """
let drawn = null; window.frames_drawn = 0;
for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"]) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) { drawn = this; return draw.apply(this, given) };
}
const count = () => {
  if (drawn) { window.frames_drawn += 1; window.canvas = `${drawn.drawingBufferWidth}x${drawn.drawingBufferHeight}` }
  drawn = null; requestAnimationFrame(count);
};
requestAnimationFrame(count);
"""
RENDERER = """() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  const known = gl?.getExtension("WEBGL_debug_renderer_info");
  return known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "unknown";
}"""


@contextmanager
def program(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a command of rlservo until the block ends."""
    line = [sys.executable, "-m", "rlservo.deploy.cli", *words]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(60)


def wait_for_server(url: str, server: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            urllib.request.urlopen(f"{url}/v1/policies", timeout=5).close()
            return
        except (urllib.error.URLError, OSError):
            if server.poll() is not None or time.monotonic() > deadline:
                sys.exit("the server did not start: run `rlservo serve` by itself to see why")
            time.sleep(0.2)


def cpu_seconds(programs: dict[str, int]) -> dict[str, float]:
    """Return the processor time so far by purpose: `programs` by name, and the browser's parts."""
    spent: defaultdict[str, float] = defaultdict(float)
    for name, pid in programs.items():
        root = psutil.Process(pid)
        for process in (root, *root.children(recursive=True)):
            try:
                words, times = " ".join(process.cmdline()), process.cpu_times()
            except psutil.Error:
                continue
            part = name
            if name == "browser":
                part = "graphics" if "--type=gpu-process" in words else "page" if "--type=renderer" in words else name
            spent[part] += times.user + times.system
    return spent


def measure(page: Any, seconds: float, programs: dict[str, int]) -> tuple[str, ...]:
    def state() -> tuple[float, int, dict[str, float]]:
        return time.perf_counter(), page.evaluate("window.frames_drawn"), cpu_seconds(programs)

    page.wait_for_timeout(1e3 * SETTLE_S)
    began, frames_before, cpu_before = state()
    page.wait_for_timeout(1e3 * seconds)
    ended, frames, cpu = state()
    drawn = frames - frames_before
    published = re.search(r"(\d+) frames/s", page.inner_text("body"))
    shares = {part: 1e3 * (cpu[part] - cpu_before[part]) / max(1, drawn) for part in sorted(cpu)}
    return (
        page.evaluate("window.canvas"),
        f"{drawn / (ended - began):.1f}",
        published[1] if published else "?",
        f"{sum(shares.values()):.0f}: " + ", ".join(f"{part} {share:.0f}" for part, share in shares.items()),
    )


def look(browser: Any, address: str, window: str, arguments: Any, pids: dict[str, int]) -> tuple[tuple[str, ...], str]:
    """Open a window and measure; return a line of the table, and what draws."""
    width, height = map(int, window.split("x"))
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.add_init_script(COUNTER)
    page.goto(address)
    page.wait_for_selector("text=frames/s", timeout=1e3 * PATIENCE_S)
    result, graphics = measure(page, arguments.seconds, pids), str(page.evaluate(RENDERER))
    context.close()
    return (window, *result), graphics


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    return port


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the cockpit in a browser.")
    parser.add_argument("policies", type=Path, help="folder of bundles")
    parser.add_argument("--policy", default="ur5")
    parser.add_argument("--seconds", type=float, default=8.0, help="per window")
    parser.add_argument("--window", nargs="*", default=["1280x720", "800x600"])
    parser.add_argument("--resolution", nargs="*", type=float, default=[1.0, 0.5])
    parser.add_argument("--browser", default="chromium", help="Chromium or Chrome")
    parser.add_argument("--browser-argument", nargs="*", default=[], metavar="FLAG")
    arguments = parser.parse_args()
    path = shutil.which(arguments.browser)
    if path is None:
        parser.error(f"--browser {arguments.browser}: there is no such program")
    server_port, page_port = free_port(), free_port()
    url = f"http://127.0.0.1:{server_port}"
    table = Table(title="Cockpit")
    for column in ("window", "canvas", "drawn /s", "published /s", "ms of processor time for a frame"):
        table.add_column(column)
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", *arguments.browser_argument]
    graphics = ""
    with program("serve", str(arguments.policies), "--port", str(server_port)) as server:
        wait_for_server(url, server)
        with (
            program("cockpit", "--url", url, "--policy", arguments.policy, "--port", str(page_port)) as cockpit,
            sync_playwright() as playwright,
        ):
            assert cockpit.stdout is not None and "cockpit at" in cockpit.stdout.readline()
            browser = playwright.chromium.launch(executable_path=path, headless=True, args=flags)
            (driver,) = (each for each in psutil.Process().children() if each.pid not in (server.pid, cockpit.pid))
            pids = {"server": server.pid, "cockpit": cockpit.pid, "browser": driver.pid}
            for window, resolution in itertools.product(arguments.window, arguments.resolution):
                query = "" if resolution == 1 else f"/?fixedDpr={resolution:g}"
                row, graphics = look(browser, f"http://127.0.0.1:{page_port}{query}", window, arguments, pids)
                table.add_row(*row)
            browser.close()
    console = Console(width=140)
    console.print(table)
    console.print(f"drawn by: {graphics}; {psutil.cpu_count()} cores")


if __name__ == "__main__":
    main()
