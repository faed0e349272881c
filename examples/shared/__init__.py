"""Library of the example scripts: training runs, command lines, search spaces, episode traces."""
