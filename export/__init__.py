"""Exporter: turns a checkpoint into a policy bundle, proven equal to the trainer's own actions."""
