"""Design of a sensor: outline, thickness, electrodes and their contact areas.

`outline` and `surface` hold the shapes of the body, `electrode` and `regular_layouts` the
electrodes, `sensor` the design of all and what it rests on. `contact_areas` puts electrodes on the
body, as strips or pads; `patches` cuts these out of a mesh.
"""
