"""The UR arms: their parameters, and a MuJoCo model and simulation of each."""
