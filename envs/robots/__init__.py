"""Arms behind the environments: what an arm is, and a real UR arm with limits, watchdog and a state machine."""
