"""Parity gate: proof that an exported policy computes the trainer's own actions, or the reason why not."""
