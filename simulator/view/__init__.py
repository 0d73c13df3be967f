"""Pictures and VTK files of sensors, scenes and fields.

`scene_pictures` composes panels, which `drawing` draws; `vtu` writes the fields for ParaView.
"""
