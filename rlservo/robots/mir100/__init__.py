"""The MiR100: its parameters, worlds, laser scanners, and a MuJoCo simulation."""
