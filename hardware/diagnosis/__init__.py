"""The sensor check: what is wrong with electrodes, wires and front end."""
