"""Task of the Franka Emika Panda, with robo-gym 2.1's contract."""
