"""Flight recorder: decisions of policies written to MCAP files beside the loop, read back, shown and converted."""
