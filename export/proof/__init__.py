"""Parity gate: an exported policy computes the trainer's own actions, or the reason why it does not."""
