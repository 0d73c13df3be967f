"""Pictures and VTK files of sensors, scenes and fields.

`model_pictures` and `scene_pictures` compose panels, which `drawing` draws; `vtu` writes the fields
for ParaView.
"""
