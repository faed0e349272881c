"""Policy bundle, its contract and the errors: shared by the exporter and everything that runs a policy."""
