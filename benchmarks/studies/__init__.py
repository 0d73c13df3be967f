"""Studies: measurements that only pages quote, run from a checkout and not part of the wheel."""

import os

# As the command line does: on a busy machine threads of one process wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
