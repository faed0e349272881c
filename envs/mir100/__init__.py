"""Tasks of the MiR100 mobile robot."""
