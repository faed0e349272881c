"""From an RLlib checkpoint to a policy bundle, proven equal."""
