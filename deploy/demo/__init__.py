"""`rlservo demo`: export, serve and drive the shipped robots, and draw the result."""
