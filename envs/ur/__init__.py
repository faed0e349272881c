"""Tasks of the Universal Robots arms: ur3, ur3e, ur5, ur5e, ur10, ur10e, ur16e."""
