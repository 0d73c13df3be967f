"""Scene of one moment: bend, roll, twist and touches (`scene`) with their `indenters`."""
