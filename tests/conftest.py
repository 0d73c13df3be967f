"""Set-up shared by all tests."""

import os
from pathlib import Path

# As the command line does, and for torch too; here before the first test module loads them. Workers
# are processes of their own: more threads than cores only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Solved presses are kept between runs, apart from the user's own.
os.environ.setdefault("EITSKIN_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))
