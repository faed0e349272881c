"""UR controller on MuJoCo for tests without an arm: RTDE, dashboard and script ports, link faults.

docs/reference/ur-controller.md lists its known differences from a real one.
"""
