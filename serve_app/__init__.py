"""Policy server: one application, run by uvicorn or by Ray Serve."""
