"""onnxruntime sessions, with the same settings for the exporter's gate and for serving."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import onnxruntime


def without_telemetry() -> Any:
    """Import onnxruntime and return it.

    Its Linux wheels (1.31) report use to Microsoft from the moment they are imported unless this is set (its
    Privacy.md). Code that exports or runs a policy must not call home; set the variable to 0 to allow it.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    return onnxruntime


def open_ort_session(file: Path, threads: int = 1, simplified: Path | None = None) -> onnxruntime.InferenceSession:
    """Return a session on the CPU with this number of threads; one is fastest for networks of a policy's size.

    The file is not needed afterwards. A graph can make onnxruntime read further files from the file's folder: one of
    unknown origin is opened as `Bundle.verified_copy`, which is in no folder. `simplified` is a file for the graph as
    onnxruntime simplifies it within ONNX's own operators.

    Raises onnxruntime's own exceptions, which share no base but Exception.
    """
    ort = without_telemetry()
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4  # errors arrive as exceptions; onnxruntime would print them as well
    if simplified is not None:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(simplified)
    # A second thread that spins for work takes a core from the robot's control loop.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # From the path: from bytes onnxruntime 1.31 parses with the interpreter's lock held (0.3 s for 200 MB, during
    # which no policy acts), keeps them indefinitely, and takes twice the memory.
    session: onnxruntime.InferenceSession
    session = ort.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    session.disable_fallback()  # it would open the file again
    return session
