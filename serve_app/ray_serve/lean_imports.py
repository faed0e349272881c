"""Settings for a Ray process of `rlservo serve`'s that make its imports cheaper; to be imported before Serve.

Serve (2.60) imports pandas to encode data frames, which no reply of ours is: 0.4 s of CPU time in each of five
processes. It takes pandas for not installed and goes on without. Collections of garbage while modules are imported find
nothing: Python's threshold of 700 objects costs 0.2 s more.
"""

import gc
import sys
from typing import Any

gc.set_threshold(100_000)
modules: dict[str, Any] = sys.modules
modules.setdefault("pandas", None)  # `import pandas` raises ImportError
