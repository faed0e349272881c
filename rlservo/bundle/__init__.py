"""Policy bundle and its contract: shared by the exporter and everything that runs a policy."""
