"""Conductive layer deformed by a scene, the input of the electrical model.

`pressed_touches` turns touches into dents and their images, `dents` superposes these to a
deformation (distant images interpolated by `smooth_field`), `deformed_layer` pulls the
conductivity back to the flat layer.
"""
