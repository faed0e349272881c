"""Flight recorder: decisions of policies written to MCAP files alongside the loop, read back, shown and converted."""
