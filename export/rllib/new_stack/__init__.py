"""Policies of RLlib's new API stack: restored with their connector pipelines, and run as RLlib itself would."""
