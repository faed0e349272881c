"""Putting the parts together: the command line, the demo, and the files that deploy a server."""
