"""Engines that run the one application: uvicorn on this machine, or Ray Serve on a cluster."""
