"""What happens to a sensor at one moment: its bend, its touches and their indenters."""
