"""robo-gym's robot servers and server manager over the simulators of this package: no ROS, no Gazebo."""
