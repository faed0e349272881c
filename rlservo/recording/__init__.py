"""Recordings of policies' decisions in MCAP files: written beside the control loop, read, shown and converted."""
