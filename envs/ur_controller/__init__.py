"""UR controller on MuJoCo for tests without an arm: RTDE, dashboard and script ports, link faults."""
