"""UR controller on MuJoCo for tests without an arm: RTDE, dashboard and script ports, link faults.

It knowingly differs from a real one:

- The arm is our MuJoCo model; every stop decelerates at 10 rad/s^2, real ones follow the stopping-time limits.
- servoJ follows with a critically damped filter whose lag is the look-ahead time; gain and slider do not change it.
- A protective stop comes from a contact, joint limit or jump of the target (over 40 rad/s^2), not from forces or
  planes, and ends the program instead of pausing it.
- Currents, temperatures, voltages, forces and inputs are constants.
- Ports 30001 to 30003 send no state; URScript other than ur-rtde's is not run.
- No safeguard stop, no reduced mode.
"""
