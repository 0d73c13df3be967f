"""Design of a sensor: outline, thickness, electrodes and their contact areas.

`outline` and `surface` hold the shapes of the body, `electrode` and `regular_layouts` the
electrodes, `support` what the body rests on, `sensor` the design of all. `placement` puts
electrodes on the body, as strips (`side_contacts`) or pads (`flat_contacts`); `patches` cuts their
contact areas out of a mesh.
"""
