"""Set-up shared by all tests."""

import os
from pathlib import Path

# As the command line does; here before the first test module loads numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Solved presses are kept between runs, apart from the user's own.
os.environ.setdefault("EITSKIN_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))
