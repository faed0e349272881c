"""Open Inference Protocol v2, as KServe's and Triton's clients speak it: over HTTP and gRPC."""
