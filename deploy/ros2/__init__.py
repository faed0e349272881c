"""The policy as a ROS 2 node: `rlservo ros2`, and the package that `ros2 run` and `ros2 launch` find."""
