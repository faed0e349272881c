"""Policies of RLlib's old API stack: restored with their connectors, and run as RLlib itself would."""
