"""A bundle's graph as dependency-free C99: generated, compiled, and proven against onnxruntime."""
