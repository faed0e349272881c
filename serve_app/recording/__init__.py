"""Recorder: decisions of policies in MCAP files, written alongside the loop, read back, shown and converted."""
