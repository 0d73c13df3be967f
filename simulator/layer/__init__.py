"""Conductive layer deformed by a scene, the input of the electrical model.

`pressed_touches` turns touches into dents, those to given depths by `depth_search`, and their
corrections. `dents` adds these up to a deformation, `bent_presses` on a bent sensor.
`deformed_layer` pulls the conductivity back to the flat layer.
"""
