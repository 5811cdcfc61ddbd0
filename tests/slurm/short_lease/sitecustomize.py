"""On PYTHONPATH in the test that kills a node: its runs' locks are believed for 15 s instead of 120."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from space_dist.ledger import lock  # noqa: E402 - libraries read those when they are imported

lock.LEASE_SECONDS = 15.0
