"""Independent 3D reference of presses: finite elements of NGSolve on the whole sensor stack."""
