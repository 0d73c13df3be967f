"""Twin: the physical numbers behind one sensor, fitted to labelled frames, with standard errors."""
