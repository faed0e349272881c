"""rlservo's own server, as `rlservo serve` starts it.

python benchmarks/peers/rlservo_server.py PORT BUNDLE
"""

from __future__ import annotations

import sys

from rlservo.serve_app.launcher import serve_policies

if __name__ == "__main__":
    serve_policies([sys.argv[2]], port=int(sys.argv[1]))
