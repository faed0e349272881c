"""Arms behind the environments: the arm interface, and a real UR arm with limits, watchdog and state machine."""
