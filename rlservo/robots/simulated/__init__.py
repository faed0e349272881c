"""Simulated controllers behind the interfaces of real ones: a UR controller's ports, ROS 2 and rosbridge."""
