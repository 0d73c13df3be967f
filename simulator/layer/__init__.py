"""What a scene makes of the conductive layer: dents, deformed conductivity, contact areas."""
