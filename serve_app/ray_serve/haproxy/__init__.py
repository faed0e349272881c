"""HAProxy before Ray Serve: edits of the configuration that Ray writes, listening sockets and watcher that outlive it.

`wrapper.py` is the program that Ray runs as the HAProxy binary. It runs without site-packages, since it stands in the
way of every change of replicas, so the modules it imports need the standard library alone.
"""
