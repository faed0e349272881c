"""Robots behind ROS 2 or a rosbridge: links, message conversions, an arm, a mobile base."""
