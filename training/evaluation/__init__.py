"""How good a pipeline is: metrics, Cramer-Rao bounds and report folders."""
