"""Studies of data: recordings, recipes, and pipelines trained on datasets."""
