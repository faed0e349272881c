"""Applications: the command line, the demo, the cockpit, and the files that deploy a server."""
