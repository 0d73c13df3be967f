"""Studies of layouts: pipelines trained for electrode layouts, and the angles they tell."""
