"""Checkpoint files of RLlib: find, fetch, unpickle and describe them without importing RLlib."""
