"""Set-up shared by all tests."""

import os

# As the command line does; here before the first test module loads numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
