"""Measure training briefly, as benchmarks/training.py does, and keep its files. Runs in a Ray: `trainings.py`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import measuring
import training

training.warm_up()
rows = [training.measure("CartPole-v1", 1, 4, 1, 512, limit) for limit in (0.05, 200.0)]
for row in rows:
    print(training.line(row))
measuring.write(Path(), "training", training.document(rows, "CartPole-v1", 512))
