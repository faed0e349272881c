"""Ray workers forked from a process that has imported torch, which takes half of a short training's processor time.

This file stands for Python in Ray's runtime environment (`py_executable`). It asks that process for a worker, with its
arguments, environment, folder and streams, and stays until the worker ends.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from pathlib import Path

ADDRESS = "FORKED_WORKERS"  # the variable with a socket's name, which leaves no file


def main() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.connect("\0" + os.environ[ADDRESS])
        request = json.dumps([sys.argv[1:], dict(os.environ), str(Path.cwd())]).encode()
        socket.send_fds(connection, [request], [0, 1, 2])
        connection.recv(1)  # nothing: it is closed when the worker ends


def start() -> str:
    """Fork the process that forks workers; it ends with this one. Return the runtime environment's `py_executable`.

    A worker leaves this function as an exception, and ends.
    """
    ours, theirs = os.pipe()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    os.environ[ADDRESS] = f"forked-workers-{os.getpid()}"
    listener.bind("\0" + os.environ[ADDRESS])
    listener.listen()
    if os.fork() == 0:
        os.close(theirs)
        _fork_workers(listener, ours)
    listener.close()
    os.close(ours)  # the other end stays open as long as this process
    return f"{sys.executable} -ISu {__file__}"


def _fork_workers(listener: socket.socket, parent: int) -> None:
    import select
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # workers that ended leave nothing
    while parent not in select.select([listener, parent], [], [])[0]:
        connection, _ = listener.accept()
        request, streams, _, _ = socket.recv_fds(connection, 1 << 20, 3)
        if os.fork() == 0:
            os.close(parent)
            listener.close()
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            _become(*json.loads(request), streams)
        connection.close()
        for each in streams:
            os.close(each)
    os._exit(0)


def _become(arguments: list[str], environment: dict[str, str], folder: str, streams: list[int]) -> None:
    import runpy

    import numpy as np
    import torch

    os.setsid()
    for number, each in enumerate(streams):
        os.dup2(each, number)
        os.close(each)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = arguments
    sys.path[:0] = [word for word in environment.get("PYTHONPATH", "").split(os.pathsep) if word]
    np.random.seed()  # each its own numbers
    torch.seed()
    runpy.run_path(arguments[0], run_name="__main__")
    sys.exit()


if __name__ == "__main__":
    main()
