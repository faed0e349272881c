"""UR controller on MuJoCo for tests without an arm: RTDE, dashboard and script ports, link faults.

It knowingly differs from a real one:

- The arm is our MuJoCo model; every stop decelerates at 10 rad/s^2, real ones follow the stopping-time limits.
- servoJ follows with a critically damped filter whose lag is the look-ahead time; gain and slider do not change it.
- A protective stop comes from a contact, joint limit or jump of the target (over 40 rad/s^2), not from forces, tool
  speed or planes, and ends the program instead of pausing it.
- An arm that is led by hand has no friction; payload and tool centre point are taken and change nothing.
- Currents, temperatures, voltages, forces and inputs are constants.
- Power, brakes and an emergency stop's release take no time; no safeguard stop, no reduced mode.
- The dashboard loads, plays and pauses nothing and shows no popup.
- RTDE is protocol 2 and sends no text messages. Ports 30001 to 30003 send no state; URScript other than ur-rtde's is
  not run, and of that not moveL, servoL, force mode and inverse kinematics.
- A controller that the machine holds up makes its cycles good afterwards, with one waiting command each.
"""
