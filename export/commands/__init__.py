"""Commands of the exporter: export, verify, prune, inspect."""
