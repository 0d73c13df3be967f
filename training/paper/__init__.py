"""The method of the paper: classifier, bend regression, reconstruction and post-processor."""
