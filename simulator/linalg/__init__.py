"""Direct solvers for symmetric systems: factorise once, solve for many right-hand sides."""
