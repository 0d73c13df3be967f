"""Pictures and VTK files of sensors, scenes and fields."""
