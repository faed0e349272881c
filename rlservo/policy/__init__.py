"""In-process runtime: load a policy bundle, check it, act. Needs numpy and onnxruntime only."""
