"""Exporter: an RLlib checkpoint becomes a policy bundle, proven equal to RLlib's own actions."""
