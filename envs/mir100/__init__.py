"""The MiR100 mobile robot: one simulation, and the environments over it."""
