"""Studies: measurements that only pages quote, run from a checkout and not part of the wheel."""
