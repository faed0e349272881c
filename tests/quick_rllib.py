"""Process settings that only make RLlib start sooner; importing this module sets them.

The tests' processes import it first (`conftest.py`), and so do Ray's workers of their trainings
(`trainings.environment`).
"""

import gc
import inspect
import sys
import traceback

# A collection walks all that torch and RLlib have made, and by Python's own threshold one comes every 700 objects: a
# quarter of the time of their import.
gc.set_threshold(100_000, 20, 20)

# RLlib's readers of recorded samples do without it if it is not installed. It imports what it finds of boto3, Google's
# and Azure's: a sixth of RLlib's import.
sys.modules["smart_open"] = None  # type: ignore[assignment]


def stack(context: int = 1) -> list[inspect.FrameInfo]:
    """Return the caller's stack without source lines.

    RLlib (ray 2.60) asks for it with each connector, and `inspect` looks for each of its files in all loaded modules:
    20 ms each, of an export that takes a second.
    """
    frames = [frame for frame, _ in traceback.walk_stack(sys._getframe(1))]
    return [inspect.FrameInfo(f, f.f_code.co_filename, f.f_lineno, f.f_code.co_name, None, None) for f in frames]


inspect.stack = stack
