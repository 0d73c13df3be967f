"""Command line: `eitskin simulate`, `generate`, `train`, `evaluate`, `live` and so on.

`entry` -> `main` -> `commands`, `demo` and `page` (the live page), which share `options` and
`terminal`.
"""

import os

# The solver's blocks are too small to share between threads: on busy cores several threads only
# wait for each other. Set before numpy loads its BLAS; the user's own setting wins.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
