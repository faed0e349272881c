"""Let torch compute on one thread while a policy is exported or verified."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Set torch to one thread and back: for networks of this size a second one costs more than it saves.

    On a busy machine it is much more: an LSTM's step of 0.1 ms was seen to take 11 ms with two.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
