"""The command `eitskin live`: options, the session, recordings, tasks asked for meanwhile."""
