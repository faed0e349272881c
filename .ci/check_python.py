"""Check of `make setup`'s Python: new enough for constraints.txt, and the one that the virtual environment has.

Run with the Python that PYTHON names, which may be of any version; the argument is the environment's folder.
"""

# ruff: noqa: UP032 - f-strings would be a syntax error to the Pythons that are refused here

import subprocess
import sys

ours = "{}.{}".format(*sys.version_info[:2])
if sys.version_info < (3, 11):
    sys.exit(
        "{} is Python {}: the versions in constraints.txt need 3.11 or newer (PYTHON=python3.11 names another; "
        "rlservo itself runs on 3.10)".format(sys.executable, ours)
    )
try:
    program = "import sys; print('{}.{}'.format(*sys.version_info[:2]))"
    theirs = subprocess.check_output([sys.argv[1] + "/bin/python", "-c", program], text=True).strip()
except (OSError, subprocess.CalledProcessError):  # no environment, or its Python is gone: it is made again
    theirs = ours
if theirs != ours:
    sys.exit(
        "{0} has Python {1}, and PYTHON={2} is {3}: 'rm -rf {0}' lets it be made again, VENV=.venv{3} makes "
        "another".format(sys.argv[1], theirs, sys.executable, ours)
    )
