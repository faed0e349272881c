"""Recordings as LeRobot, Minari and Parquet data sets."""
