"""Robots behind robo-gym's interface, on their simulations or, for a UR arm, real."""
