"""Studies of hostile inputs of every kind, each read in a process that is watched."""
