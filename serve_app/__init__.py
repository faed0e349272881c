"""Policies at work: in process (`runtime`), from a client (`client`), in a control loop, on a server."""
