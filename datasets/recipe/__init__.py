"""What a dataset is drawn from: specimens, scenes, episodes, and the sampling of frames."""
