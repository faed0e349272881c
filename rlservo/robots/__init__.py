"""Robots, real and simulated, behind one interface: limits, servo loop, watchdog and states of a real arm."""
