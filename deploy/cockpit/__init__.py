"""The cockpit: a page on loopback that shows a robot, what its policy sees and does, and recordings of both."""
