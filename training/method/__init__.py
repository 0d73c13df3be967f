"""What every perception method shares: settings, input, observations, predictions, networks."""
