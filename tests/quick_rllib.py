"""Process settings that only make RLlib start sooner; importing this module sets them.

The tests' processes import it first (`conftest.py`), and so do Ray's workers of their trainings
(`trainings.environment`).
"""

import functools
import gc
import inspect

# A collection walks all that torch and RLlib have made, and by Python's own threshold one comes every 700 objects: a
# quarter of the time of their import.
gc.set_threshold(100_000, 20, 20)
# For each connector RLlib (ray 2.60) asks for the whole stack, by default with the source around all of its lines.
inspect.stack = functools.partial(inspect.stack, context=0)
