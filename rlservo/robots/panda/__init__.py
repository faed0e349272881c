"""The Panda arm: a MuJoCo model and simulation."""
