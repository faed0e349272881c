"""Parity gate: an exported policy computes RLlib's own actions, or the reason why it does not."""
