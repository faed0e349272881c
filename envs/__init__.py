"""MuJoCo simulators of UR arms and the MiR100 with robo-gym's contract. `gym.make` finds them without this import."""
