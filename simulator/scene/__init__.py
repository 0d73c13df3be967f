"""Scene of one moment: bend, roll, twist and touches with their indenters.

A `Scene` (`scene`) holds touches (`touch`), each with an indenter of a closed form (`indenters`) or
from a file (`scanned_indenter`).
"""
