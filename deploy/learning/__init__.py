"""Learning from recordings: recorded episodes as RLlib's own, and the loop that trains a served policy."""
