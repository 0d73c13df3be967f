"""Design of a sensor: outline, thickness, electrodes and their contact areas.

`outline` and `surface` hold the shapes of the body, `electrode` the electrodes, `sensor` the design
of all and what it rests on. `placement` puts electrodes on the body, as strips or pads
(`contact_areas`); `patches` cuts their contact areas out of a mesh.
"""
